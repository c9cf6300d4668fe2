// Types of requests to a session.

import type { ClientMessage, Hello } from "./protocol";

/** A hello without the camera, which the first frame defines. */
export type Setup = Omit<Hello, "type" | "camera" | "resume">;

/** Requests that are answered by `acknowledged`. */
export type Request = Extract<ClientMessage, { request: number }>;

/** A request without its number. */
export type Asked = { [K in Request["type"]]: Omit<Extract<Request, { type: K }>, "request"> }[Request["type"]];
