// The recording that comes with the page.

const FILE = "sample.probeless";

let known: Promise<File> | null = null;

/** Fetched once. Throws Error, one sentence. */
export function fetchSample(): Promise<File> {
  known ??= load().catch((error: unknown) => {
    known = null;
    throw error;
  });
  return known;
}

async function load(): Promise<File> {
  const response = await fetch(FILE).catch(() => null);
  if (response === null) throw new Error("The server does not answer: try again when it is there.");
  if (!response.ok) throw new Error(`The sample cannot be fetched: the server answers ${response.status}.`);
  return new File([await response.blob()], "The sample");
}
