import { describe, expect, it } from "vitest";
import { alignTruth, type Matrix3, orthogonalFactor, rotationOf } from "../src/data/alignment";

/** Numbers that look random and are the same each time. */
function random(seed: number): () => number {
  let state = seed;
  return () => {
    state = (state * 1664525 + 1013904223) % 2 ** 32;
    return state / 2 ** 31 - 1;
  };
}

const multiply = (A: Matrix3, B: Matrix3): Matrix3 =>
  Float64Array.from({ length: 9 }, (_, i) =>
    [0, 1, 2].reduce((sum, k) => sum + A[3 * Math.floor(i / 3) + k] * B[3 * k + (i % 3)], 0),
  );
const transpose = (A: Matrix3): Matrix3 =>
  Float64Array.from({ length: 9 }, (_, i) => A[3 * (i % 3) + Math.floor(i / 3)]);
const inner = (A: Matrix3, B: Matrix3): number => A.reduce((sum, a, i) => sum + a * B[i], 0);
const IDENTITY = Float64Array.of(1, 0, 0, 0, 1, 0, 0, 0, 1);

function expectClose(A: ArrayLike<number>, B: ArrayLike<number>, digits = 9): void {
  expect(A.length).toBe(B.length);
  for (let i = 0; i < A.length; i += 1) expect(A[i]).toBeCloseTo(B[i], digits);
}

function matrix(next: () => number): Matrix3 {
  return Float64Array.from({ length: 9 }, next);
}

describe("the orthogonal factor", () => {
  it("is orthogonal and best among many others", () => {
    const next = random(1);
    for (let trial = 0; trial < 50; trial += 1) {
      const M = matrix(next);
      const Q = orthogonalFactor(M);
      expectClose(multiply(Q, transpose(Q)), IDENTITY);
      for (let other = 0; other < 20; other += 1) {
        expect(inner(orthogonalFactor(matrix(next)), M)).toBeLessThanOrEqual(inner(Q, M) + 1e-9);
      }
    }
  });

  it("of an orthogonal matrix is that matrix, a reflection too", () => {
    const Q = orthogonalFactor(matrix(random(5)));
    const mirrored = multiply(Q, Float64Array.of(1, 0, 0, 0, 1, 0, 0, 0, -1));
    expectClose(orthogonalFactor(Q), Q);
    expectClose(orthogonalFactor(mirrored), mirrored);
  });

  it.each([0, 1, 2])("is orthogonal for a matrix of rank %i", (rank) => {
    const next = random(9);
    const M = new Float64Array(9);
    for (let k = 0; k < rank; k += 1) {
      const [u, v] = [
        [next(), next(), next()],
        [next(), next(), next()],
      ];
      for (let i = 0; i < 9; i += 1) M[i] += u[Math.floor(i / 3)] * v[i % 3];
    }
    const Q = orthogonalFactor(M);
    expectClose(multiply(Q, transpose(Q)), IDENTITY, 6);
  });
});

describe("aligning ground truth", () => {
  const frames = 5;
  const points = 12;
  const next = random(3);
  const shapes = Array.from({ length: frames }, () =>
    Float32Array.from({ length: 3 * points }, () => 10 * next()),
  );
  const cameras = Array.from({ length: frames }, () =>
    [...orthogonalFactor(matrix(next))].slice(0, 6),
  ).flat();
  const shown = {
    shapes,
    frameNumbers: [0, 1, 2, 3, 4],
    pointNumbers: Array.from({ length: points }, (_, i) => i),
  };
  const Q = orthogonalFactor(matrix(next));

  /** The shapes as ground truth: turned, moved in each frame, and in the camera's frame or not. */
  function truthOf(camera: boolean) {
    const data = new Float64Array(frames * points * 3);
    for (let t = 0; t < frames; t += 1) {
      const turn = camera ? multiply(Q, rotationOf(cameras, t)) : Q;
      for (let j = 0; j < points; j += 1) {
        for (let r = 0; r < 3; r += 1) {
          data[(t * points + j) * 3 + r] =
            [0, 1, 2].reduce((sum, c) => sum + turn[3 * r + c] * shapes[t][3 * j + c], 0) + 7 * t;
        }
      }
    }
    return { shape: [frames, points, 3], dtype: "<f8", data };
  }

  it.each(["object", "camera"] as const)("finds turn and shift in the %s frame", (frame) => {
    const aligned = alignTruth(
      truthOf(frame === "camera"),
      { frames, points },
      shown,
      cameras,
      frame,
    )!;
    for (let t = 0; t < frames; t += 1) expectClose(aligned.frames[t], shapes[t], 4);
    for (const error of aligned.errors) expect(error).toBeLessThan(1e-5);
  });

  it.each(["object", "camera"] as const)(
    "fits a scale to varying cameras in the %s frame",
    (frame) => {
      const scaled = cameras.map((value, k) => value * (1 + 0.1 * Math.floor(k / 6)));
      const truth = truthOf(frame === "camera");
      const larger = { ...truth, data: truth.data.map((value) => 3 * value) };
      const aligned = alignTruth(larger, { frames, points }, shown, scaled, frame)!;
      for (let t = 0; t < frames; t += 1) expectClose(aligned.frames[t], shapes[t], 4);
      for (const error of aligned.errors) expect(error).toBeLessThan(1e-5);
      expect(aligned.sigma).toBeCloseTo(
        alignTruth(truth, { frames, points }, shown, cameras, frame)!.sigma,
      );
      const charged = alignTruth(larger, { frames, points }, shown, cameras, frame)!;
      expect(Math.min(...charged.errors)).toBeGreaterThan(0.1);
    },
  );

  it("takes all orders of axes", () => {
    const { data } = truthOf(false);
    const rows = new Float64Array(data.length);
    for (let t = 0; t < frames; t += 1) {
      for (let j = 0; j < points; j += 1) {
        for (let r = 0; r < 3; r += 1) {
          rows[(3 * t + r) * points + j] = data[(t * points + j) * 3 + r];
        }
      }
    }
    for (const shape of [
      [3 * frames, points],
      [frames, 3, points],
    ]) {
      const truth = { shape, dtype: "<f8", data: rows };
      const aligned = alignTruth(truth, { frames, points }, shown, cameras, "object")!;
      expect(Math.max(...aligned.errors)).toBeLessThan(1e-5);
    }
    const other = { shape: [frames, points + 1, 3], dtype: "<f8", data };
    expect(alignTruth(other, { frames, points }, shown, cameras, "object")).toBeNull();
  });
});
