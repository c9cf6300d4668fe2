// What is asked of a server's session, whoever captures.

import type { ClientMessage, Hello } from "./protocol";

/** A hello but for the camera, which the first frame says. */
export type Setup = Omit<Hello, "type" | "camera" | "resume">;

/** What is answered by `acknowledged`. */
export type Request = Extract<ClientMessage, { request: number }>;

/** A request before it has its number. */
export type Asked = { [K in Request["type"]]: Omit<Extract<Request, { type: K }>, "request"> }[Request["type"]];
