/** The service, as the page calls it. */

export type Status = "queued" | "running" | "succeeded" | "failed" | "cancelled";

/** A problem document (RFC 9457). */
export interface Problem {
  type: string;
  title: string;
  status: number;
  detail?: string | null;
  instance?: string | null;
}

export interface Job {
  id: string;
  status: Status;
  name: string | null;
  batch: string | null;
  created_at: string;
  started_at: string | null;
  finished_at: string | null;
  expires_at: string | null;
  attempt: number;
  queue_position: number | null;
  cancel_requested: boolean;
  options: Record<string, unknown>;
  inputs: Record<string, { name: string; bytes: number; link?: string }>;
  frames: number | null;
  points: number | null;
  progress: { stage: string; fraction: number; iteration: number; residual: number | null } | null;
  timings: Record<string, number>;
  metrics: Metrics | null;
  diagnostics: {
    converged: boolean;
    basis_size: number;
    camera_model: string;
    camera_reason: string;
    cautions: { code: string; message: string }[];
  } | null;
  problem: Problem | null;
  links: Record<string, string | null | undefined>;
}

/** How some numbers lie. */
export interface Spread {
  count: number;
  mean: number;
  median: number;
  min: number;
  max: number;
}

/** Jobs that share a label; the lower members are missing in a list. */
export interface Batch {
  label: string;
  total: number;
  jobs: Record<Status, number>;
  created_at: string;
  links: Record<"self" | "jobs" | "cancel" | "retry" | "results", string | null>;
  progress?: number;
  e3d?: Spread | null;
  timings?: { elapsed: number | null; run_total: number; run: Spread | null };
}

export interface Metrics {
  e3d: number;
  e3d_per_frame?: number;
  relative_rms?: number;
  scale?: number;
  per_frame?: number[];
  frame?: "object" | "camera";
}

export interface Option {
  name: string;
  type: "integer" | "number" | "boolean" | "string";
  default: number | boolean | string | null;
  help: string;
  minimum: number | null;
  maximum: number | null;
  choices: string[] | null;
  nullable: boolean;
}

export interface Info {
  version: string;
  limits: { upload_bytes: number };
  formats: { measurements: string[] };
  options: Option[];
}

export const isActive = (job: Job): boolean => job.status === "queued" || job.status === "running";

/** The service refused a request, or a job failed. */
export class Refused extends Error {
  constructor(readonly problem: Problem) {
    super(problem.detail ?? problem.title);
  }
}

/** No answer came. */
export class Unreachable extends Error {
  constructor() {
    super("The service does not answer. It may be restarting, or the connection is down.");
  }
}

/** Address of a path of the service: those of its documents are absolute, ours relative. */
export const address = (path: string): string => new URL(path, document.baseURI.split("#")[0]).href;

const KEY = "smsr-key";
export const key = {
  get: (): string | null => sessionStorage.getItem(KEY),
  set: (value: string): void => sessionStorage.setItem(KEY, value),
  clear: (): void => sessionStorage.removeItem(KEY),
};

/** Called when the service wants a key, or another one. */
export const onKeyWanted = new Set<() => void>();

/** Whether the service answers, as the last request found. */
export const connection = {
  lost: false,
  /** Called when it is lost, and when it is there again. */
  onchange: new Set<() => void>(),
  set(lost: boolean): void {
    if (lost === this.lost) return;
    this.lost = lost;
    for (const changed of this.onchange) changed();
  },
};

export function authorised(headers: HeadersInit = {}): Headers {
  const all = new Headers(headers);
  const known = key.get();
  if (known) all.set("Authorization", `Bearer ${known}`);
  return all;
}

/** Ask the service; an answer that is an error is thrown as Refused. */
export async function ask(path: string, init: RequestInit = {}): Promise<Response> {
  let answer: Response;
  try {
    answer = await fetch(address(path), { ...init, headers: authorised(init.headers) });
  } catch (error) {
    if ((error as Error).name === "AbortError") throw error;
    connection.set(true);
    throw new Unreachable();
  }
  connection.set(false);
  if (answer.ok || answer.status === 304) return answer;
  throw refusal(answer.status, await answer.text());
}

export function refusal(status: number, body: string): Refused {
  if (status === 401) for (const wanted of onKeyWanted) wanted();
  try {
    const problem = JSON.parse(body) as Problem;
    if (typeof problem.title === "string") return new Refused(problem);
  } catch {
    // Something in between answered, and not with a problem document.
  }
  const title = status === 413 ? "The upload is too large" : `The server answered ${status}`;
  return new Refused({ type: "about:blank", title, status });
}

export async function json<T>(path: string, init?: RequestInit): Promise<T> {
  return (await ask(path, init)).json() as Promise<T>;
}

let infoOnce: Promise<Info> | null = null;
export function info(): Promise<Info> {
  infoOnce ??= json<Info>("v1/info").catch((error) => {
    infoOnce = null;
    throw error;
  });
  return infoOnce;
}

export const getJob = (id: string, signal?: AbortSignal): Promise<Job> =>
  json<Job>(`v1/jobs/${encodeURIComponent(id)}`, { signal });

export const listJobs = (path: string, signal?: AbortSignal) =>
  json<{ jobs: Job[]; next: string | null }>(path, { signal });

export const getBatch = (label: string, signal?: AbortSignal): Promise<Batch> =>
  json<Batch>(`v1/batches/${encodeURIComponent(label)}`, { signal });

export const listBatches = (signal?: AbortSignal) =>
  json<{ batches: Batch[]; next: string | null }>("v1/batches?limit=20", { signal });

export const post = <T>(path: string): Promise<T> => json<T>(path, { method: "POST" });
export const remove = (path: string): Promise<Response> => ask(path, { method: "DELETE" });

/** What the documentation of a problem's type advises. */
export async function remedyOf(problem: Problem): Promise<string | null> {
  if (!problem.type.startsWith("/")) return null;
  try {
    const headers = { Accept: "application/json" };
    const documented = await json<{ remedy: string }>(problem.type.slice(1), { headers });
    return documented.remedy;
  } catch {
    return null;
  }
}

/** Save a file: by its address where that is enough, else with the key, through memory. */
export async function save(path: string, name: string): Promise<void> {
  let href = address(path);
  const held = key.get() !== null;
  if (held) href = URL.createObjectURL(await (await ask(path)).blob());
  const anchor = document.createElement("a");
  anchor.href = href;
  anchor.download = name;
  anchor.click();
  if (held) setTimeout(() => URL.revokeObjectURL(href), 60_000);
}
