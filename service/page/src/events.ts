/** Jobs as they change: Server-Sent Events, and polling where a proxy lets none through. */

import { ask, getJob, isActive, type Job, Refused } from "./api";

export interface ServerEvent {
  name: string;
  data: string;
  id: string | null;
}

/** Cut a stream of text into events (WHATWG HTML, section 9.2.6). */
export class EventParser {
  private rest = "";
  private name = "";
  private data: string[] = [];
  private id: string | null = null;

  /** Take more of the stream; return the events that ended in it. */
  push(text: string): ServerEvent[] {
    const found: ServerEvent[] = [];
    this.rest += text;
    // A carriage return at the end may be half of a line's end.
    const cut = this.rest.endsWith("\r") ? this.rest.length - 1 : this.rest.length;
    const lines = this.rest.slice(0, cut).split(/\r\n|\n|\r/);
    this.rest = lines.pop()! + this.rest.slice(cut);
    for (const line of lines) {
      if (line === "") {
        if (this.data.length) {
          found.push({ name: this.name || "message", data: this.data.join("\n"), id: this.id });
        }
        this.name = "";
        this.data = [];
        continue;
      }
      const colon = line.indexOf(":");
      const field = colon < 0 ? line : line.slice(0, colon);
      const value = colon < 0 ? "" : line.slice(colon + 1).replace(/^ /, "");
      if (field === "event") this.name = value;
      else if (field === "data") this.data.push(value);
      else if (field === "id") this.id = value;
    }
    return found;
  }
}

/** EventSource sends no Authorization header, so the stream is read by fetch. */
async function* stream(
  path: string,
  lastId: string | null,
  signal: AbortSignal,
): AsyncGenerator<ServerEvent> {
  const headers: Record<string, string> = { Accept: "text/event-stream" };
  if (lastId !== null) headers["Last-Event-ID"] = lastId;
  const answer = await ask(path, { headers, signal, cache: "no-store" });
  if (!answer.body || !answer.headers.get("content-type")?.startsWith("text/event-stream")) return;
  const parser = new EventParser();
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    yield* parser.push(value);
  }
}

const pause = (milliseconds: number, signal: AbortSignal): Promise<void> =>
  new Promise((resolve) => {
    const timer = setTimeout(resolve, milliseconds);
    signal.addEventListener("abort", () => {
      clearTimeout(timer);
      resolve();
    });
  });

const RECONNECT = 2000;
const POLL = 1000;

/** Whether an error says that there are no events here, as opposed to a broken connection. */
const noEvents = (error: unknown): boolean =>
  error instanceof Refused && error.problem.type !== "/problems/queue-unavailable";

/** Follow a job until it has ended, is gone (null), or the signal aborts. */
export async function followJob(
  id: string,
  changed: (job: Job | null) => void,
  signal: AbortSignal,
): Promise<void> {
  let lastId: string | null = null;
  let streaming = true;
  while (!signal.aborted) {
    try {
      if (streaming) {
        for await (const event of stream(`v1/jobs/${id}/events`, lastId, signal)) {
          lastId = event.id;
          if (event.name === "deleted") return changed(null);
          const job = JSON.parse(event.data) as Job;
          if (!isActive(job)) return changed(await getJob(id, signal));
          changed(job);
        }
      }
      const job = await getJob(id, signal);
      changed(job);
      if (!isActive(job)) return;
      await pause(POLL, signal);
    } catch (error) {
      if (signal.aborted) return;
      if (error instanceof Refused && error.problem.type === "/problems/unknown-job") {
        return changed(null);
      }
      if (noEvents(error)) streaming = false;
      await pause(RECONNECT, signal);
    }
  }
}

/** Follow all jobs until the signal aborts; `refresh` asks for the list to be read anew. */
export async function followJobs(
  on: { refresh: () => void; job: (job: Job) => void; deleted: (id: string) => void },
  signal: AbortSignal,
): Promise<void> {
  let streaming = true;
  while (!signal.aborted) {
    try {
      if (streaming) {
        for await (const event of stream("v1/events", null, signal)) {
          if (event.name === "refresh") on.refresh();
          else if (event.name === "job") on.job(JSON.parse(event.data));
          else if (event.name === "deleted") on.deleted(JSON.parse(event.data).id);
        }
      } else if (!document.hidden) {
        on.refresh();
      }
    } catch (error) {
      if (signal.aborted) return;
      if (noEvents(error)) {
        streaming = false;
        on.refresh();
      }
    }
    await pause(RECONNECT, signal);
  }
}
