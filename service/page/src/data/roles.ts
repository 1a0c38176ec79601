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

/** Give each file a role, the most certain first; null where every likely role is taken. */
export function guessRoles(files: Candidate[]): (Role | null)[] {
  const roles: (Role | null)[] = files.map(() => null);
  const open = new Set<Role>(ROLES);
  const pairs = files
    .flatMap((file, index) => {
      const score = scores(file);
      return ROLES.map((role) => ({ index, role, score: score[role] }));
    })
    .sort((a, b) => b.score - a.score);
  for (const { index, role, score } of pairs) {
    if (roles[index] === null && open.has(role) && score > 0) {
      roles[index] = role;
      open.delete(role);
    }
  }
  return roles;
}
