/** A made-up sequence, so that a first look needs no data: a waving sheet before a swinging camera. */

import { writeNpy } from "./npy";

export function exampleFiles(frames = 60, side = 40): File[] {
  const points = side * side;
  const truth = new Float32Array(frames * points * 3);
  const tracks = new Float32Array(2 * frames * points);
  for (let t = 0; t < frames; t += 1) {
    const time = t / (frames - 1);
    const yaw = 0.9 * Math.sin(3 * Math.PI * time + 0.6);
    const pitch = 0.35 * Math.sin(2.2 * Math.PI * time + 1.1);
    const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    for (let i = 0; i < points; i += 1) {
      const a = (2 * (i % side)) / (side - 1) - 1;
      const b = (2 * Math.floor(i / side)) / (side - 1) - 1;
      const breath = 1 + 0.25 * Math.sin(4 * Math.PI * time);
      const fold = 0.22 * Math.sin(5 * time + 2.2) * Math.cos(2.4 * a + 1.2 * b);
      const wave = 0.16 * Math.sin(3 * a - 7 * time) * (0.4 + 0.6 * b * b);
      const x = 170 * (a + 0.08 * b * Math.sin(6 * time));
      const y = 170 * 1.1 * b;
      const z = -170 * (0.75 * breath * (1 - 0.55 * a * a - 0.35 * b * b) + fold + wave);
      truth.set([x, y, z], 3 * (t * points + i));
      tracks[2 * t * points + i] = cy * x + sy * z + 320 + 20 * Math.sin(5 * time);
      tracks[(2 * t + 1) * points + i] =
        sp * sy * x + cp * y - sp * cy * z + 240 + 12 * Math.cos(4 * time);
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
