/** 2D tracks, whatever the order of rows in which they came. */

import type { NumberArray } from "./npy";

/** Positions of points over time; some of the points where there are very many. */
export interface Tracks {
  frames: number;
  /** Points that are held here. */
  points: number;
  /** Points of the whole. */
  total: number;
  /** (T, points, 2), NaN where a point is not seen. */
  positions: Float32Array;
  /** Least and greatest u and v over all frames. */
  bounds: { left: number; right: number; top: number; bottom: number };
}

export type Layout = "auto" | "interleaved" | "stacked";

/** Points that a drawing of tracks holds at most. */
const MOST_POINTS = 5000;

/** Return [frames, points] of a measurement array, or null where it can be none. */
export function extentOf(shape: number[]): [number, number] | null {
  if (shape.length === 2) return shape[0] % 2 ? null : [shape[0] / 2, shape[1]];
  if (shape.length !== 3) return null;
  if (shape[1] === 2) return [shape[0], shape[2]];
  if (shape[2] === 2) return [shape[0], shape[1]];
  return null;
}

/** View an array of measurements as tracks; null where its shape is none of theirs. */
export function tracksOf(array: NumberArray, layout: Layout = "auto"): Tracks | null {
  const { shape, data } = array;
  const extent = extentOf(shape);
  if (!extent) return null;
  const [frames, total] = extent;
  const points = Math.min(total, MOST_POINTS);
  let at: (frame: number, point: number, axis: number) => number;
  if (shape.length === 2) {
    at =
      layout === "stacked"
        ? (t, i, axis) => (axis * frames + t) * total + i
        : (t, i, axis) => (2 * t + axis) * total + i;
  } else if (shape[1] === 2) {
    at = (t, i, axis) => (2 * t + axis) * total + i;
  } else {
    at = (t, i, axis) => (t * total + i) * 2 + axis;
  }
  const positions = new Float32Array(frames * points * 2);
  let write = 0;
  for (let t = 0; t < frames; t += 1) {
    for (let k = 0; k < points; k += 1) {
      const i = points === total ? k : Math.floor((k * total) / points);
      positions[write++] = data[at(t, i, 0)];
      positions[write++] = data[at(t, i, 1)];
    }
  }
  return { frames, points, total, positions, bounds: boundsOf(positions) };
}

/** Whether v seems to grow upwards: a frame with negative coordinates is none of pixels. */
export function growsUp({ positions, points }: Tracks): boolean {
  for (let i = 0; i < 2 * points; i += 1) if (positions[i] < 0) return true;
  return false;
}

function boundsOf(positions: Float32Array): Tracks["bounds"] {
  const bounds = { left: Infinity, right: -Infinity, top: Infinity, bottom: -Infinity };
  for (let i = 0; i < positions.length; i += 2) {
    const u = positions[i];
    const v = positions[i + 1];
    if (!Number.isFinite(u) || !Number.isFinite(v)) continue;
    if (u < bounds.left) bounds.left = u;
    if (u > bounds.right) bounds.right = u;
    if (v < bounds.top) bounds.top = v;
    if (v > bounds.bottom) bounds.bottom = v;
  }
  return bounds;
}
