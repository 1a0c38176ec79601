/** Guessing what a file is from its name and its array. */

import type { Inspected } from "./files";
import { extentOf } from "./tracks";

export type Role = "measurements" | "ground_truth" | "faces";
export const ROLES: Role[] = ["measurements", "ground_truth", "faces"];
export const ROLE_NAMES: Record<Role, string> = {
  measurements: "Measurements",
  ground_truth: "Ground truth",
  faces: "Faces",
};

interface Candidate {
  name: string;
  inspected: Inspected;
}

/** What is wrong with the shape of an array in a role, or null. */
export function misfit(
  role: Role,
  shape: number[],
  tracks: [frames: number, points: number] | null,
): string | null {
  if (role === "measurements") {
    const extent = extentOf(shape);
    if (!extent) return "Tracks have the shape (2T, N), (T, 2, N) or (T, N, 2).";
    if (extent[0] < 3 || extent[1] < 4) return "At least 3 frames and 4 points are needed.";
    return null;
  }
  if (role === "faces") {
    return shape.length === 2 && shape[1] === 3 ? null : "Faces have the shape (F, 3).";
  }
  const [frames, points] = tracks ?? [null, null];
  const fits = (T: number, N: number) => T === (frames ?? T) && N === (points ?? N);
  const [a, b, c] = shape;
  const fitting =
    shape.length === 2
      ? a % 3 === 0 && fits(a / 3, b)
      : shape.length === 3 && ((b === 3 && fits(a, c)) || (c === 3 && fits(a, b)));
  if (fitting) return null;
  const wanted = tracks ? ` with T = ${frames} and N = ${points}, as the tracks have` : "";
  return `Ground truth has the shape (3T, N), (T, N, 3) or (T, 3, N)${wanted}.`;
}

/** Score from which a file is taken for one more of measurements. */
const LIKELY = 3;

/** Likelihood of each role, in points that only compare. */
function scores({ name, inspected }: Candidate): Record<Role, number> {
  const score = { measurements: 1, ground_truth: 0, faces: 0 };
  const stem = name.toLowerCase().replace(/\.[a-z]+(\.gz)?$/, "");
  if (/face|triang|tri$|mesh|topo|connect/.test(stem)) score.faces += 6;
  if (/ground|truth|(^|[_\-.])gt([_\-.]|$)|shape|3d|(^|[_-])s$/.test(stem)) score.ground_truth += 6;
  if (/measure|track|2d|(^|[_-])w$|uv|image/.test(stem)) score.measurements += 6;
  const { shape, dtype } = inspected;
  if (!shape) return score;
  const integers = dtype !== null && /[iu]\d$/.test(dtype);
  if (shape.length === 2 && shape[1] === 3) score.faces += integers ? 8 : 2;
  if (shape.length === 3 && (shape[1] === 3 || shape[2] === 3)) score.ground_truth += 8;
  const extent = extentOf(shape);
  if (extent) score.measurements += shape.length === 3 ? 8 : 2;
  else score.measurements -= 4;
  if (shape.length === 2 && shape[0] % 3 === 0 && shape[0] > 6) score.ground_truth += 1;
  return score;
}

/**
 * Give each file a role, the most certain first; null where every likely role is taken. Several
 * files may be measurements, each of a sequence of its own.
 */
export function guessRoles(files: Candidate[]): (Role | null)[] {
  const roles: (Role | null)[] = files.map(() => null);
  const open = new Set<Role>(ROLES);
  const pairs = files
    .flatMap((file, index) => {
      const score = scores(file);
      if (files.some((other) => isTruthOf(file, other))) score.ground_truth += 4;
      return ROLES.map((role) => ({ index, role, score: score[role] }));
    })
    .sort((a, b) => b.score - a.score);
  for (const { index, role, score } of pairs) {
    const further = role === "measurements" && score >= LIKELY;
    if (roles[index] === null && score > 0 && (open.has(role) || further)) {
      roles[index] = role;
      open.delete(role);
    }
  }
  return roles;
}

/** Whether an array has three rows for each two of another: x, y, z of the same points. */
function isTruthOf({ inspected: { shape: a } }: Candidate, { inspected: { shape: b } }: Candidate) {
  return a?.length === 2 && b?.length === 2 && 2 * a[0] === 3 * b[0] && a[1] === b[1];
}
