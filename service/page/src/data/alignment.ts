/** Ground truth in the frame of the result, and the distance of each point from it. */

import type { NumberArray } from "./npy";

/** 3 by 3, row after row. */
export type Matrix3 = Float64Array;

/**
 * The orthogonal matrix U V^T of a singular value decomposition M = U S V^T.
 *
 * It maximises tr(Q^T M) over all orthogonal Q, reflections among them (orthogonal Procrustes).
 * Where M has rank 1 or 0 the missing directions are any that complete a basis.
 */
export function orthogonalFactor(M: Matrix3): Matrix3 {
  const { values, vectors } = eigenSymmetric(gram(M));
  const order = [0, 1, 2].sort((a, b) => values[b] - values[a]);
  const right = order.map((k) => [vectors[k], vectors[3 + k], vectors[6 + k]]);
  const largest = Math.sqrt(Math.max(values[order[0]], 0));
  const left: number[][] = [];
  for (const v of right) {
    let u = [0, 1, 2].map((r) => M[3 * r] * v[0] + M[3 * r + 1] * v[1] + M[3 * r + 2] * v[2]);
    const strong = norm(u) > 1e-9 * largest && largest > 0;
    for (const known of left) u = minus(u, known, dot(u, known));
    if (!strong || norm(u) === 0) u = completing(left);
    const length = norm(u);
    left.push(u.map((x) => x / length));
  }
  const Q = new Float64Array(9);
  for (let r = 0; r < 3; r += 1) {
    for (let c = 0; c < 3; c += 1) {
      Q[3 * r + c] = left.reduce((sum, u, k) => sum + u[r] * right[k][c], 0);
    }
  }
  return Q;
}

const dot = (a: number[], b: number[]): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const norm = (a: number[]): number => Math.sqrt(dot(a, a));
const minus = (a: number[], b: number[], k: number): number[] => a.map((x, i) => x - k * b[i]);

/** A unit vector at right angles to those given (at most two). */
function completing(known: number[][]): number[] {
  let best = [0, 0, 0];
  for (const axis of [0, 1, 2]) {
    let e = [0, 0, 0];
    e[axis] = 1;
    for (const k of known) e = minus(e, k, dot(e, k));
    if (norm(e) > norm(best)) best = e;
  }
  return best;
}

function gram(M: Matrix3): Matrix3 {
  const G = new Float64Array(9);
  for (let i = 0; i < 3; i += 1) {
    for (let j = 0; j < 3; j += 1) {
      for (let k = 0; k < 3; k += 1) G[3 * i + j] += M[3 * k + i] * M[3 * k + j];
    }
  }
  return G;
}

/** Eigenvalues and eigenvectors (columns) of a symmetric matrix, by Jacobi rotations. */
function eigenSymmetric(A: Matrix3): { values: number[]; vectors: Matrix3 } {
  const a = A.slice();
  const V = Float64Array.of(1, 0, 0, 0, 1, 0, 0, 0, 1);
  for (let sweep = 0; sweep < 30; sweep += 1) {
    const off = a[1] * a[1] + a[2] * a[2] + a[5] * a[5];
    if (off <= 1e-30 * (a[0] * a[0] + a[4] * a[4] + a[8] * a[8])) break;
    for (const [p, q] of [
      [0, 1],
      [0, 2],
      [1, 2],
    ]) {
      const pq = a[3 * p + q];
      if (pq === 0) continue;
      const theta = (a[3 * q + q] - a[3 * p + p]) / (2 * pq);
      const t = (theta >= 0 ? 1 : -1) / (Math.abs(theta) + Math.sqrt(theta * theta + 1));
      const c = 1 / Math.sqrt(t * t + 1);
      const s = t * c;
      for (let k = 0; k < 3; k += 1) {
        const [x, y] = [a[3 * k + p], a[3 * k + q]];
        a[3 * k + p] = c * x - s * y;
        a[3 * k + q] = s * x + c * y;
      }
      for (let k = 0; k < 3; k += 1) {
        const [x, y] = [a[3 * p + k], a[3 * q + k]];
        a[3 * p + k] = c * x - s * y;
        a[3 * q + k] = s * x + c * y;
        const [v, w] = [V[3 * k + p], V[3 * k + q]];
        V[3 * k + p] = c * v - s * w;
        V[3 * k + q] = s * v + c * w;
      }
    }
  }
  return { values: [a[0], a[4], a[8]], vectors: V };
}

/** Find entry (frame, point, axis) of ground truth; null where the array has another extent. */
function truthIndex(
  shape: number[],
  frames: number,
  points: number,
): ((t: number, i: number, axis: number) => number) | null {
  const [a, b, c] = shape;
  if (shape.length === 2 && a === 3 * frames && b === points) {
    return (t, i, axis) => (3 * t + axis) * points + i;
  }
  if (shape.length === 3 && a === frames && b === points && c === 3) {
    return (t, i, axis) => (t * points + i) * 3 + axis;
  }
  if (shape.length === 3 && a === frames && b === 3 && c === points) {
    return (t, i, axis) => (3 * t + axis) * points + i;
  }
  return null;
}

/** The length of both rows of a camera: 1, or its scale where that varies. */
function scaleOf(cameras: ArrayLike<number>, frame: number): number {
  let squares = 0;
  for (let k = 0; k < 6; k += 1) squares += cameras[6 * frame + k] ** 2;
  return Math.sqrt(squares / 2) || 1;
}

function scalesVary(cameras: ArrayLike<number>): boolean {
  for (let t = 0; 6 * t < cameras.length; t += 1) {
    if (Math.abs(scaleOf(cameras, t) - 1) > 1e-4) return true;
  }
  return false;
}

/** The rows of a camera, without its scale, completed by the viewing direction: R3_t. */
export function rotationOf(cameras: ArrayLike<number>, frame: number): Matrix3 {
  const R = new Float64Array(9);
  const scale = scaleOf(cameras, frame);
  for (let k = 0; k < 6; k += 1) R[k] = cameras[6 * frame + k] / scale;
  R[6] = R[1] * R[5] - R[2] * R[4];
  R[7] = R[2] * R[3] - R[0] * R[5];
  R[8] = R[0] * R[4] - R[1] * R[3];
  return R;
}

export interface AlignedTruth {
  /** Each shown frame's true points, (K, 3), centred and turned onto the shapes. */
  frames: Float32Array[];
  /** Mean standard deviation of the true coordinates at the size of the shapes, the unit of e3D. */
  sigma: number;
  /** Mean distance in each shown frame in units of sigma: its part of e3D. */
  errors: number[];
}

/** What of a result is shown: some frames of it, and some of the points. */
export interface Shown {
  /** Positions (K, 3) in each shown frame. */
  shapes: Float32Array[];
  /** Numbers of the shown frames in the result. */
  frameNumbers: ArrayLike<number>;
  /** Numbers of the shown points in the result. */
  pointNumbers: ArrayLike<number>;
}

/**
 * Carry ground truth onto the shapes by one orthogonal matrix for the whole sequence.
 *
 * In the frame "camera" the shapes are turned into each frame's camera first, as the truth is. One
 * scale for the sequence is fitted where that of the cameras varies, which leaves the size open.
 */
export function alignTruth(
  truth: NumberArray,
  total: { frames: number; points: number },
  shown: Shown,
  cameras: ArrayLike<number>,
  frame: "object" | "camera",
): AlignedTruth | null {
  const at = truthIndex(truth.shape, total.frames, total.points);
  if (!at) return null;
  const count = shown.pointNumbers.length;
  const cross = new Float64Array(9);
  const centred: Float32Array[] = [];
  let deviations = 0;
  let size = 0;
  for (let k = 0; k < shown.shapes.length; k += 1) {
    const t = shown.frameNumbers[k];
    const X = shown.shapes[k];
    const G = new Float32Array(3 * count);
    const g = [0, 0, 0];
    const x = [0, 0, 0];
    for (let j = 0; j < count; j += 1) {
      for (let axis = 0; axis < 3; axis += 1) {
        const value = truth.data[at(t, shown.pointNumbers[j], axis)];
        G[3 * j + axis] = value;
        g[axis] += value / count;
        x[axis] += X[3 * j + axis] / count;
      }
    }
    const squares = [0, 0, 0];
    const part = new Float64Array(9);
    for (let j = 0; j < count; j += 1) {
      for (let axis = 0; axis < 3; axis += 1) {
        const value = truth.data[at(t, shown.pointNumbers[j], axis)] - g[axis];
        G[3 * j + axis] = value;
        squares[axis] += value * value;
        for (let c = 0; c < 3; c += 1) part[3 * axis + c] += value * (X[3 * j + c] - x[c]);
        size += (X[3 * j + axis] - x[axis]) ** 2;
      }
    }
    deviations += squares.reduce((sum, s) => sum + Math.sqrt(s / count), 0) / 3;
    const turned = frame === "camera" ? timesTransposed(part, rotationOf(cameras, t)) : part;
    for (let k9 = 0; k9 < 9; k9 += 1) cross[k9] += turned[k9];
    centred.push(G);
  }
  const Q = orthogonalFactor(cross);
  const scale = scalesVary(cameras)
    ? Q.reduce((sum, q, k) => sum + q * cross[k], 0) / (size || 1)
    : 1;
  const sigma = deviations / shown.shapes.length / scale;
  const errors: number[] = [];
  for (let k = 0; k < centred.length; k += 1) {
    // G ~ Q R X, so that R^T Q^T G lies on X.
    const turn = frame === "camera" ? product(Q, rotationOf(cameras, shown.frameNumbers[k])) : Q;
    for (let i = 0; i < centred[k].length; i += 1) centred[k][i] /= scale;
    errors.push(turnOnto(centred[k], turn, shown.shapes[k]) / (sigma * count));
  }
  return { frames: centred, sigma, errors };
}

/** Turn G by the transpose of a matrix in place, put it at the mean of X; the sum of distances. */
function turnOnto(G: Float32Array, turn: Matrix3, X: Float32Array): number {
  const count = G.length / 3;
  const mean = [0, 0, 0];
  for (let i = 0; i < X.length; i += 1) mean[i % 3] += X[i] / count;
  let sum = 0;
  for (let i = 0; i < G.length; i += 3) {
    const [a, b, c] = [G[i], G[i + 1], G[i + 2]];
    let square = 0;
    for (let axis = 0; axis < 3; axis += 1) {
      const value = turn[axis] * a + turn[3 + axis] * b + turn[6 + axis] * c + mean[axis];
      G[i + axis] = value;
      square += (value - X[i + axis]) ** 2;
    }
    sum += Math.sqrt(square);
  }
  return sum;
}

function product(A: Matrix3, B: Matrix3): Matrix3 {
  const C = new Float64Array(9);
  for (let i = 0; i < 3; i += 1) {
    for (let j = 0; j < 3; j += 1) {
      for (let k = 0; k < 3; k += 1) C[3 * i + j] += A[3 * i + k] * B[3 * k + j];
    }
  }
  return C;
}

function timesTransposed(A: Matrix3, B: Matrix3): Matrix3 {
  const C = new Float64Array(9);
  for (let i = 0; i < 3; i += 1) {
    for (let j = 0; j < 3; j += 1) {
      for (let k = 0; k < 3; k += 1) C[3 * i + j] += A[3 * i + k] * B[3 * j + k];
    }
  }
  return C;
}
