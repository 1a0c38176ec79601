/**
 * Viridis (van der Walt and Smith, 2015): even steps to the eye, and to the colour-blind. Its darkest
 * eighth is left out, which could not be told from the dark background.
 */

const ANCHORS = (
  "472f7d 414487 39568c 31688e 2a788e 23888e " +
  "1f988b 22a884 35b779 54c568 7ad151 a5db36 d2e21b fde725"
)
  .split(" ")
  .map((hex) => [0, 2, 4].map((i) => Number.parseInt(hex.slice(i, i + 2), 16)));

/** Red, green and blue, 0 to 255, at a place between 0 and 1. */
export function viridis(place: number): [number, number, number] {
  const at = Math.min(Math.max(place, 0), 1) * (ANCHORS.length - 1);
  const low = Math.min(Math.floor(at), ANCHORS.length - 2);
  const part = at - low;
  return [0, 1, 2].map((i) =>
    Math.round(ANCHORS[low][i] * (1 - part) + ANCHORS[low + 1][i] * part),
  ) as [number, number, number];
}

/** The ramp as RGBA bytes, for a texture. */
export function ramp(steps = 256): Uint8Array {
  const out = new Uint8Array(4 * steps);
  for (let i = 0; i < steps; i += 1) out.set([...viridis(i / (steps - 1)), 255], 4 * i);
  return out;
}

/** Round numbers that divide a range into about `wanted` parts. */
export function ticks(low: number, high: number, wanted = 5): number[] {
  if (!(high > low)) return [low];
  const rough = (high - low) / wanted;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((k) => k * power).find((s) => s >= rough * 0.999)!;
  const out: number[] = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) {
    out.push(Number((k * step).toPrecision(12)));
  }
  return out;
}
