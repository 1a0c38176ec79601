/** A made-up sequence, so that a first look needs no data: a waving sheet before a swinging camera. */

import { writeNpy } from "./npy";

/** Half the width of the sheet in pixels. */
const SCALE = 170;

export function exampleFiles(frames = 60, side = 40): File[] {
  const points = side * side;
  const truth = new Float32Array(frames * points * 3);
  const tracks = new Float32Array(2 * frames * points);
  for (let t = 0; t < frames; t += 1) {
    const time = t / (frames - 1);
    const yaw = 0.95 * Math.sin(3 * Math.PI * time + 0.6);
    const pitch = 0.42 * Math.sin(2.2 * Math.PI * time + 1.1);
    const roll = 0.1 * Math.sin(1.4 * Math.PI * time);
    const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    const [cr, sr] = [Math.cos(roll), Math.sin(roll)];
    // A mean shape and three ways to deform, each with a rhythm of its own.
    const breath = Math.sin(4 * Math.PI * time);
    const fold = Math.sin(6 * Math.PI * time + 1);
    const twist = Math.cos(2.6 * Math.PI * time + 0.3);
    for (let i = 0; i < points; i += 1) {
      const a = (2 * (i % side)) / (side - 1) - 1;
      const b = (2 * Math.floor(i / side)) / (side - 1) - 1;
      const x = SCALE * (a + 0.1 * twist * b);
      const y = SCALE * (1.1 * b + 0.06 * breath * a * a);
      const z =
        -SCALE *
        (0.8 * (1 - 0.55 * a * a - 0.35 * b * b) +
          0.14 * breath * (1 - a * a) +
          0.13 * fold * Math.cos(2.2 * a + b) +
          0.12 * twist * Math.sin(2.6 * a) * b);
      const u = cy * x + sy * z;
      const v = sp * sy * x + cp * y - sp * cy * z;
      truth.set([x, y, z], 3 * (t * points + i));
      tracks[2 * t * points + i] = cr * u - sr * v + 320;
      tracks[(2 * t + 1) * points + i] = sr * u + cr * v + 240;
    }
  }
  const faces: number[] = [];
  for (let r = 0; r + 1 < side; r += 1) {
    for (let c = 0; c + 1 < side; c += 1) {
      const i = r * side + c;
      faces.push(i, i + side, i + 1, i + 1, i + side, i + side + 1);
    }
  }
  const file = (name: string, bytes: Uint8Array<ArrayBuffer>) => new File([bytes], name);
  return [
    file("measurements.npy", writeNpy(tracks, [2 * frames, points])),
    file("ground_truth.npy", writeNpy(truth, [frames, points, 3])),
    file("faces.npy", writeNpy(Int32Array.from(faces), [faces.length / 3, 3])),
  ];
}
