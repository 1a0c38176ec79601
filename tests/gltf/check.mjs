// Validates GLB files and plays them: node check.mjs FILE... prints a JSON list.
//
// For each file: the report of Khronos' validator, and the positions (and normals) of all points at
// the time of each frame and halfway to the next, as three.js computes them.

import { readFile } from "node:fs/promises";

import { AnimationMixer, Vector3 } from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import validator from "gltf-validator";

globalThis.self = globalThis; // three.js looks for the window

async function play(data) {
  const buffer = data.buffer.slice(data.byteOffset, data.byteOffset + data.byteLength);
  const gltf = await new GLTFLoader().parseAsync(buffer, "");
  const object = gltf.scene.getObjectByProperty("isMesh", true)
    ?? gltf.scene.getObjectByProperty("isPoints", true);
  gltf.scene.updateMatrixWorld(true);
  const { geometry } = object;
  const morphed = (name) => {
    const base = geometry.attributes[name];
    if (!base) return null;
    const found = [];
    for (let i = 0; i < base.count; i += 1) {
      const value = new Vector3().fromBufferAttribute(base, i);
      (geometry.morphAttributes[name] ?? []).forEach((target, k) => {
        const weight = object.morphTargetInfluences[k];
        if (weight) value.addScaledVector(new Vector3().fromBufferAttribute(target, i), weight);
      });
      found.push(value);
    }
    return found;
  };
  const clip = gltf.animations[0];
  const times = clip ? Array.from(clip.tracks[0].times) : [0];
  const mixer = new AnimationMixer(gltf.scene);
  if (clip) mixer.clipAction(clip).play();
  const frames = times.map((time, k) => {
    const at = (when) => {
      mixer.setTime(when);
      return morphed("position").map((p) => p.applyMatrix4(object.matrixWorld).toArray());
    };
    const halfway = k + 1 < times.length ? at((time + times[k + 1]) / 2) : null;
    // A loop is over at its end, where it begins again.
    const shown = at(k + 1 < times.length ? time : time - 1e-6);
    const normals = morphed("normal")?.map((n) => n.normalize().toArray()) ?? null;
    return { time, shown, halfway, normals };
  });
  return {
    type: object.type,
    index: geometry.index ? Array.from(geometry.index.array) : null,
    colours: Boolean(geometry.attributes.color),
    box: geometry.boundingBox,
    names: Object.keys(object.morphTargetDictionary ?? {}),
    frames,
  };
}

const reports = [];
for (const path of process.argv.slice(2)) {
  const data = await readFile(path);
  const { issues, info } = await validator.validateBytes(new Uint8Array(data), { maxIssues: 100 });
  reports.push({ issues, info, played: await play(data) });
}
process.stdout.write(JSON.stringify(reports));
