/** Faces for points that came without: a Delaunay triangulation of what the mean camera sees. */

import Delaunator from "delaunator";
import { rotationOf } from "../data/alignment";

/** Edges so many times longer than the median are bridges over holes and between parts. */
const LONGEST = 8;

/** Return triangles as places of points, (F * 3). */
export function meanViewTriangles(
  shapes: Float32Array[],
  frameNumbers: ArrayLike<number>,
  cameras: ArrayLike<number>,
): Uint32Array {
  const points = shapes[0].length / 3;
  const plane = new Float64Array(2 * points);
  const some = Math.max(1, Math.floor(shapes.length / 50));
  for (let k = 0; k < shapes.length; k += some) {
    const R = rotationOf(cameras, frameNumbers[k]);
    const X = shapes[k];
    for (let i = 0; i < points; i += 1) {
      for (let axis = 0; axis < 2; axis += 1) {
        plane[2 * i + axis] +=
          R[3 * axis] * X[3 * i] + R[3 * axis + 1] * X[3 * i + 1] + R[3 * axis + 2] * X[3 * i + 2];
      }
    }
  }
  const { triangles } = new Delaunator(plane);
  const square = (a: number, b: number) =>
    (plane[2 * a] - plane[2 * b]) ** 2 + (plane[2 * a + 1] - plane[2 * b + 1]) ** 2;
  const longest = (f: number) =>
    Math.max(
      square(triangles[f], triangles[f + 1]),
      square(triangles[f + 1], triangles[f + 2]),
      square(triangles[f + 2], triangles[f]),
    );
  const lengths = new Float64Array(triangles.length / 3);
  for (let f = 0; f < lengths.length; f += 1) lengths[f] = longest(3 * f);
  const limit = lengths.slice().sort()[lengths.length >> 1] * LONGEST ** 2;
  const kept: number[] = [];
  for (let f = 0; f < triangles.length; f += 3) {
    if (lengths[f / 3] <= limit) kept.push(triangles[f], triangles[f + 1], triangles[f + 2]);
  }
  return Uint32Array.from(kept);
}
