/** The arrays of a result, as far as the page shows them. */

import { ask, type Job, type Problem, Refused } from "../api";
import { inspect } from "../data/files";
import { HEADER_BYTES, type NumberArray, parseHeader, readNpy } from "../data/npy";
import { type Tracks, tracksOf } from "../data/tracks";

/** Bytes of positions that are held, here and once more on the graphics card. */
const MOST_HELD = 256e6;
/** Bytes of shapes that are fetched; of longer ones every other frame, or fewer. */
const MOST_FETCHED = 1.2e9;

/** Which frames and points of a result are shown. */
export interface Plan {
  frames: number;
  points: number;
  /** Every so manieth frame is shown. */
  stride: number;
  /** Numbers of the shown frames. */
  frameNumbers: Uint32Array;
  /**
   * Numbers of the shown points, in an order every beginning of which is spread evenly over the
   * points: drawing fewer of them draws a thinner surface, not a piece of it.
   */
  pointNumbers: Uint32Array;
}

export function plan(
  frames: number,
  points: number,
  limits = { held: MOST_HELD, fetched: MOST_FETCHED },
): Plan {
  const stride = Math.max(1, Math.ceil((12 * frames * points) / limits.fetched));
  const shownFrames = Math.ceil(frames / stride);
  const shown = Math.max(1, Math.min(points, Math.floor(limits.held / (12 * shownFrames))));
  return {
    frames,
    points,
    stride,
    frameNumbers: Uint32Array.from({ length: shownFrames }, (_, k) => k * stride),
    pointNumbers: spread(points).subarray(0, shown),
  };
}

/** All numbers below `count`, each golden-ratio step away from the one before. */
export function spread(count: number): Uint32Array {
  let step = Math.max(1, Math.round(count * 0.6180339887));
  while (divisor(step, count) !== 1) step += 1;
  const order = new Uint32Array(count);
  for (let i = 1, at = 0; i < count; i += 1) {
    at = (at + step) % count;
    order[i] = at;
  }
  return order;
}

const divisor = (a: number, b: number): number => (b === 0 ? a : divisor(b, a % b));

/** Fetch the shapes, frame after frame as they come. A broken connection is taken up again. */
export async function* fetchShapes(
  job: Job,
  signal: AbortSignal,
): AsyncGenerator<Plan | Float32Array, void> {
  const path = job.links.shapes!;
  const first = await ask(path, { headers: { Range: `bytes=0-${HEADER_BYTES - 1}` }, signal });
  const whole = first.status === 200; // no ranges here: the body is the file
  const source = new Source(path, signal, whole ? first : null);
  const head = whole
    ? await source.read(0, Math.min(HEADER_BYTES, Number(first.headers.get("content-length"))))
    : new Uint8Array(await first.arrayBuffer());
  const header = parseHeader(head);
  const [frames, points] = header.shape;
  const planned = plan(frames, points);
  yield planned;
  const size = 12 * points;
  for (const frame of planned.frameNumbers) {
    const body = await source.read(header.offset + frame * size, size, planned.stride === 1);
    const positions = new Float32Array(body.buffer, body.byteOffset, 3 * points);
    yield chosen(positions, planned.pointNumbers);
  }
}

function chosen(positions: Float32Array, pointNumbers: Uint32Array): Float32Array {
  const out = new Float32Array(3 * pointNumbers.length);
  for (let j = 0, k = 0; j < pointNumbers.length; j += 1) {
    const i = 3 * pointNumbers[j];
    out[k++] = positions[i];
    out[k++] = positions[i + 1];
    out[k++] = positions[i + 2];
  }
  return out;
}

const ATTEMPTS = 4;

/** A file of the service that is read from front to back, with jumps. */
class Source {
  private reader: ReadableStreamDefaultReader<Uint8Array> | null = null;
  private at = 0;
  private rest: Uint8Array = new Uint8Array(0);
  private kept: Uint8Array | null = null;

  constructor(
    private readonly path: string,
    private readonly signal: AbortSignal,
    whole: Response | null,
  ) {
    if (whole?.body) this.reader = whole.body.getReader();
  }

  /** Return bytes in a buffer of their own; `on` says that reading goes on behind them. */
  async read(start: number, length: number, on = false): Promise<Uint8Array> {
    for (let attempt = 1; ; attempt += 1) {
      try {
        return await this.tryRead(start, length, on);
      } catch (error) {
        if (this.signal.aborted || error instanceof Refused || attempt === ATTEMPTS) throw error;
        this.reader = null;
        await new Promise((resolve) => setTimeout(resolve, 500 * 2 ** attempt));
      }
    }
  }

  private async tryRead(start: number, length: number, on: boolean): Promise<Uint8Array> {
    const out = new Uint8Array(length);
    let filled = 0;
    if (this.kept && start < this.kept.length) {
      // The beginning was read once for the header, and streams do not turn back.
      const known = this.kept.subarray(start, start + length);
      out.set(known);
      filled = known.length;
    }
    if (filled < length && (!this.reader || this.at !== start + filled)) {
      await this.open(start + filled, on ? null : start + length);
    }
    while (filled < length) {
      if (!this.rest.length) {
        const { done, value } = await this.reader!.read();
        if (done) throw new Error("The result ended early.");
        this.rest = value;
      }
      const piece = this.rest.subarray(0, length - filled);
      this.rest = this.rest.subarray(piece.length);
      out.set(piece, filled);
      filled += piece.length;
      this.at += piece.length;
    }
    if (start === 0) this.kept = out;
    return out;
  }

  private async open(start: number, end: number | null): Promise<void> {
    const headers = { Range: `bytes=${start}-${end === null ? "" : end - 1}` };
    const answer = await ask(this.path, { headers, signal: this.signal });
    this.reader = answer.body!.getReader();
    this.at = answer.status === 206 ? start : 0;
    this.rest = new Uint8Array(0);
    while (this.at + this.rest.length < start) {
      this.at += this.rest.length;
      const { done, value } = await this.reader.read();
      if (done) throw new Error("The result ended early.");
      this.rest = value;
    }
    this.rest = this.rest.subarray(start - this.at);
    this.at = start;
  }
}

export async function fetchArray(path: string, signal: AbortSignal): Promise<NumberArray> {
  return readNpy(new Uint8Array(await (await ask(path, { signal })).arrayBuffer()));
}

/** An input file as numbers, or the reason why the page cannot have them. */
export async function fetchInput(
  job: Job,
  role: string,
  signal: AbortSignal,
): Promise<NumberArray | string> {
  const file = job.inputs[role];
  if (!file?.link) return "The file is not here.";
  if (/\.(npz|mat)$/i.test(file.name)) {
    return `It was sent as ${file.name}; this page reads .npy and .csv files.`;
  }
  if (file.bytes > 512e6) return "It is too large to be read by this page.";
  try {
    const found = await inspect(await (await ask(file.link, { signal })).blob(), file.name);
    return found.array ?? found.note ?? "The file cannot be read here.";
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    return describe(error.problem);
  }
}

const describe = (problem: Problem): string => problem.detail ?? problem.title;

/** The tracks that the result projects to, where those that were sent cannot be shown. */
export function projected(
  shapes: Float32Array[],
  frameNumbers: ArrayLike<number>,
  cameras: ArrayLike<number>,
  translations: ArrayLike<number>,
): Tracks {
  const frames = shapes.length;
  const total = shapes[0].length / 3;
  const data = new Float32Array(frames * total * 2);
  let write = 0;
  for (let k = 0; k < frames; k += 1) {
    const t = frameNumbers[k];
    const X = shapes[k];
    for (let i = 0; i < X.length; i += 3) {
      for (let axis = 0; axis < 2; axis += 1) {
        const c = 6 * t + 3 * axis;
        data[write++] =
          cameras[c] * X[i] +
          cameras[c + 1] * X[i + 1] +
          cameras[c + 2] * X[i + 2] +
          translations[2 * t + axis];
      }
    }
  }
  return tracksOf({ shape: [frames, total, 2], dtype: "<f4", data })!;
}
