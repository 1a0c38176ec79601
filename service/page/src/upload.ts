/** Sending a job: in one request, or its files before it, by tus, where a break would cost much. */

import { address, authorised, connection, type Job, json, refusal, Unreachable } from "./api";

/** Bytes of all files from which they go over by tus. */
const LARGE = 64e6;
/** Pauses before it is tried again; they begin anew whenever something got over. */
const PAUSES = [500, 1000, 2000, 4000, ...Array<number>(28).fill(10_000)];

/** What is sent with a job; `progress` gets the part that is over. */
export interface Submission {
  files: Partial<Record<string, File>>;
  options: Record<string, unknown>;
  settings: Record<string, string>;
  progress: (fraction: number) => void;
  signal: AbortSignal;
}

export function submit(submission: Submission): Promise<Job> {
  const sizes = Object.values(submission.files).map((file) => file?.size ?? 0);
  const total = sizes.reduce((a, b) => a + b, 0);
  return total < LARGE ? sendWhole(submission) : sendPiecewise(submission, total);
}

/** XMLHttpRequest, because fetch does not tell how much of a body has been sent. */
function sendWhole({ files, options, settings, progress, signal }: Submission): Promise<Job> {
  const form = new FormData();
  form.set("options", JSON.stringify(options));
  for (const [name, value] of Object.entries(settings)) form.set(name, value);
  for (const [role, file] of Object.entries(files)) if (file) form.set(role, file, file.name);
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open("POST", address("v1/jobs"));
    authorised().forEach((value, name) => {
      request.setRequestHeader(name, value);
    });
    request.upload.addEventListener("progress", (event) => {
      if (event.lengthComputable) progress(event.loaded / event.total);
    });
    request.addEventListener("load", () => {
      if (request.status >= 200 && request.status < 300) resolve(JSON.parse(request.responseText));
      else reject(refusal(request.status, request.responseText));
    });
    request.addEventListener("error", () => {
      connection.set(true);
      reject(new Unreachable());
    });
    request.addEventListener("abort", () => reject(stopped()));
    signal.addEventListener("abort", () => request.abort());
    request.send(form);
  });
}

async function sendPiecewise(submission: Submission, total: number): Promise<Job> {
  const { files, options, settings, progress, signal } = submission;
  const document: Record<string, unknown> = { ...settings, options };
  let over = 0;
  for (const [role, file] of Object.entries(files)) {
    if (!file) continue;
    const id = await upload(role, file, (sent) => progress((over + sent) / total), signal);
    document[role] = { upload: id };
    over += file.size;
  }
  const headers = { "Content-Type": "application/json" };
  return json("v1/jobs", { method: "POST", headers, body: JSON.stringify(document), signal });
}

/** Send a file; return the id of the upload. It goes on where a broken connection left it. */
async function upload(
  role: string,
  file: File,
  progress: (sent: number) => void,
  signal: AbortSignal,
): Promise<string> {
  const { Upload } = await import("tus-js-client");
  return new Promise((resolve, reject) => {
    const sending = new Upload(file, {
      endpoint: address("v1/uploads"),
      metadata: { filename: file.name, role },
      headers: Object.fromEntries(authorised()),
      retryDelays: PAUSES,
      storeFingerprintForResuming: false,
      onProgress: (sent) => {
        connection.set(false);
        progress(sent);
      },
      onShouldRetry: ({ originalResponse }) => {
        const status = originalResponse?.getStatus() ?? 0;
        if (!status) connection.set(true);
        return status < 400 || status === 409 || status === 423 || status >= 500;
      },
      onSuccess: () => resolve(sending.url!.split("/").pop()!),
      onError: (error) => {
        const answer = "originalResponse" in error ? error.originalResponse : null;
        reject(answer ? refusal(answer.getStatus(), answer.getBody()) : new Unreachable());
      },
    });
    signal.addEventListener("abort", () => {
      void sending.abort(true).catch(() => {}); // what is left there the service removes in time
      reject(stopped());
    });
    sending.start();
  });
}

const stopped = (): DOMException => new DOMException("stopped", "AbortError");
