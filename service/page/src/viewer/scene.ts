/** The moving surface in 3D.
 *
 * Every frame is a buffer of its own on the graphics card, sent there once. Playing binds two of
 * them, and the shader blends; nothing is computed or copied for a frame that was shown before.
 */

import {
  BufferAttribute,
  BufferGeometry,
  DataTexture,
  Group,
  Line,
  LineBasicMaterial,
  LineSegments,
  Matrix4,
  Mesh,
  PerspectiveCamera,
  Points,
  RGBAFormat,
  ShaderMaterial,
  Scene as ThreeScene,
  Vector2,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { rotationOf } from "../data/alignment";
import { ramp } from "./colours";

export type Colouring = "plain" | "depth" | "motion" | "error";
const MODES: Record<Colouring, number> = { plain: 0, depth: 1, motion: 2, error: 2 };

export interface Look {
  colouring: Colouring;
  mesh: boolean;
  /** Diameter of a point in CSS pixels. */
  pointSize: number;
  truth: boolean;
  path: boolean;
  follow: boolean;
  /** Draw all points even where pictures then come slowly. */
  whole: boolean;
}

const VERTEX = /* glsl */ `
attribute vec3 nextPosition;
attribute vec3 reference;
attribute vec3 nextReference;
uniform float blend;
uniform int mode;
uniform vec3 depthAxis;
uniform vec2 range;
uniform vec3 plain;
uniform sampler2D ramp;
varying vec3 tint;

vec3 place() { return mix(position, nextPosition, blend); }

void colour(vec3 p) {
  if (mode == 0) { tint = plain; return; }
  float value = mode == 1
    ? dot(p, depthAxis)
    : mix(distance(position, reference), distance(nextPosition, nextReference), blend);
  float along = clamp((value - range.x) / max(range.y - range.x, 1e-30), 0.0, 1.0);
  tint = texture2D(ramp, vec2((along * 255.0 + 0.5) / 256.0, 0.5)).rgb;
}
`;

const POINT_VERTEX = /* glsl */ `${VERTEX}
uniform float pointSize;
uniform float radius;
void main() {
  vec3 p = place();
  colour(p);
  vec4 seen = modelViewMatrix * vec4(p, 1.0);
  gl_Position = projectionMatrix * seen;
  gl_PointSize = pointSize;
  // Points behind are a little darker: a cloud has no shading to tell its depth by.
  float middle = -(modelViewMatrix * vec4(0.0, 0.0, 0.0, 1.0)).z;
  tint *= 1.0 - 0.28 * clamp((-seen.z - middle) / radius + 0.5, 0.0, 1.0);
}`;

const POINT_FRAGMENT = /* glsl */ `
varying vec3 tint;
void main() {
#ifdef ROUND
  vec2 from = gl_PointCoord - 0.5;
  if (dot(from, from) > 0.25) discard;
#endif
  gl_FragColor = vec4(tint, 1.0);
}`;

const MESH_VERTEX = /* glsl */ `${VERTEX}
attribute vec3 nextNormal;
varying vec3 facing;
void main() {
  vec3 p = place();
  colour(p);
  facing = normalMatrix * mix(normal, nextNormal, blend);
  gl_Position = projectionMatrix * modelViewMatrix * vec4(p, 1.0);
}`;

const MESH_FRAGMENT = /* glsl */ `
varying vec3 tint;
varying vec3 facing;
void main() {
  vec3 n = normalize(facing);
  if (n.z < 0.0) n = -n; // both sides are lit alike
  float key = max(dot(n, normalize(vec3(-0.45, 0.6, 0.75))), 0.0);
  float shine = pow(max(dot(n, normalize(vec3(-0.25, 0.35, 1.0))), 0.0), 40.0);
  gl_FragColor = vec4(tint * (0.55 + 0.45 * key) + 0.10 * shine, 1.0);
}`;

const PLAIN = new Vector3(0.6, 0.74, 0.9);
const TRUTH = new Vector3(1.0, 0.62, 0.25);
/** Distance of the drawn cameras from the middle, in radii of the object. */
const PATH_RADII = 1.8;
/** Points whose values stand for all where a range of colours is looked for. */
const SAMPLE = 2000;
/** Part of all distances that the colours tell apart: a jump in one frame must not pale the rest. */
const LONG_TAIL = 0.985;

interface Stored {
  position: BufferAttribute;
  truth: BufferAttribute | null;
  normal: BufferAttribute | null;
}

export class Scene {
  readonly renderer: WebGLRenderer;
  private readonly scene = new ThreeScene();
  private readonly camera = new PerspectiveCamera(28, 1, 0.01, 1000);
  private readonly controls: OrbitControls;
  /** The object's frame, turned so that the camera of the tracks looks from the front. */
  private readonly world = new Group();
  private readonly points: Points<BufferGeometry, ShaderMaterial>;
  private readonly mesh: Mesh<BufferGeometry, ShaderMaterial>;
  private readonly truthPoints: Points<BufferGeometry, ShaderMaterial>;
  private readonly path = new Group();
  private readonly line = new Line(
    new BufferGeometry(),
    new LineBasicMaterial({ color: 0x8fa3b8 }),
  );
  private readonly marker = new LineSegments(
    new BufferGeometry(),
    new LineBasicMaterial({ color: 0xffb454 }),
  );
  private readonly frames: Stored[] = [];
  private faces: Uint32Array | null = null;
  private rotations: Float64Array[] = [];
  /** Sign with which the image's second axis points up, and the third of a camera to the viewer. */
  private upward: 1 | -1 = -1;
  private radius = 1;
  private moved = false;
  private asked = 0;
  private time = 0;
  private playing = false;
  private watcher: ResizeObserver;
  private ranges: Record<Colouring, [number, number]> = {
    plain: [0, 1],
    depth: [0, 1],
    motion: [0, 1],
    error: [0, 1],
  };
  look: Look = {
    colouring: "depth",
    mesh: false,
    pointSize: 3,
    truth: false,
    path: false,
    follow: false,
    whole: false,
  };
  /** Part of the points that is drawn while playing. */
  detail = 1;
  /** Pictures a second, as measured while playing. */
  rate = 0;
  private readonly pictures: number[] = [];
  /** Called when the measured rate or the detail changes. */
  onmeasure: () => void = () => {};
  private adapted = 0;

  constructor(readonly canvas: HTMLCanvasElement) {
    this.renderer = new WebGLRenderer({
      canvas,
      antialias: !isSoftware(),
      alpha: true,
      powerPreference: "high-performance",
    });
    this.renderer.setClearAlpha(0);
    const texture = new DataTexture(ramp(), 256, 1, RGBAFormat);
    texture.needsUpdate = true;
    const uniforms = () => ({
      blend: { value: 0 },
      mode: { value: 0 },
      depthAxis: { value: new Vector3(0, 0, 1) },
      range: { value: new Vector2(0, 1) },
      plain: { value: PLAIN },
      ramp: { value: texture },
      pointSize: { value: 3 },
      radius: { value: 1 },
    });
    const pointMaterial = () =>
      new ShaderMaterial({
        vertexShader: POINT_VERTEX,
        fragmentShader: POINT_FRAGMENT,
        uniforms: uniforms(),
      });
    this.points = new Points(new BufferGeometry(), pointMaterial());
    this.truthPoints = new Points(new BufferGeometry(), pointMaterial());
    this.truthPoints.material.uniforms.plain.value = TRUTH;
    this.mesh = new Mesh(
      new BufferGeometry(),
      new ShaderMaterial({
        vertexShader: MESH_VERTEX,
        fragmentShader: MESH_FRAGMENT,
        uniforms: uniforms(),
        side: 2,
      }),
    );
    this.path.add(this.line, this.marker);
    for (const part of [this.points, this.truthPoints, this.mesh, this.line, this.marker]) {
      part.frustumCulled = false;
    }
    this.world.add(this.points, this.truthPoints, this.mesh, this.path);
    this.scene.add(this.world);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = true;
    this.controls.dampingFactor = 0.15;
    this.controls.addEventListener("start", () => {
      this.moved = true;
    });
    this.controls.addEventListener("change", () => this.ask());
    this.watcher = new ResizeObserver(() => this.resize());
    this.watcher.observe(canvas);
    this.resize();
  }

  /** Say where the cameras of the tracks are: (T, 2, 3), of which the shown frames are taken. */
  setCameras(cameras: ArrayLike<number>, frameNumbers: ArrayLike<number>): void {
    this.rotations = Array.from(frameNumbers, (t) => rotationOf(cameras, t));
  }

  /** Say whether the second coordinate of the image grows upwards, other than that of pixels. */
  setUpward(upward: boolean): void {
    this.upward = upward ? 1 : -1;
    // Columns that the mean camera has as its right, up and back become x, y and z.
    const mean = Array.from({ length: 9 }, (_, i) =>
      this.rotations.reduce((sum, R) => sum + R[i], 0),
    );
    let right = new Vector3(mean[0], mean[1], mean[2]);
    let up = new Vector3(mean[3], mean[4], mean[5]);
    if (Math.min(right.length(), up.length()) < 0.35 * this.rotations.length) {
      const R = this.rotations[0]; // the camera goes all the way round: there is no mean
      right = new Vector3(R[0], R[1], R[2]);
      up = new Vector3(R[3], R[4], R[5]);
    }
    right.normalize();
    up.addScaledVector(right, -up.dot(right)).normalize().multiplyScalar(this.upward);
    const back = new Vector3().crossVectors(right, up);
    this.world.quaternion.setFromRotationMatrix(
      new Matrix4().makeBasis(right, up, back).transpose(),
    );
    if (this.frames.length) this.complete();
    this.ask();
  }

  addFrame(positions: Float32Array): void {
    const position = new BufferAttribute(positions, 3);
    this.frames.push({ position, truth: null, normal: null });
    if (this.frames.length === 1) {
      this.measureRadius();
      this.resetView();
      const many = positions.length / 3 > 30_000;
      if (!many) this.points.material.defines.ROUND = this.truthPoints.material.defines.ROUND = 1;
    }
    this.ask();
  }

  /** All frames are here: ranges of colours hold for all of them. */
  complete(): void {
    this.measureRadius();
    if (!this.moved) this.resetView();
    this.ranges.depth = this.rangeOf((k, i, X) => {
      const R = this.rotations[k];
      return this.upward * (R[6] * X[i] + R[7] * X[i + 1] + R[8] * X[i + 2]);
    });
    const motion = this.rangeOf(
      (k, i, X) =>
        distance(X, this.array(k === 0 ? Math.min(1, this.frames.length - 1) : k - 1), i),
      LONG_TAIL,
    );
    this.ranges.motion = [0, motion[1] || 1];
    this.draw();
  }

  setTruth(frames: Float32Array[]): void {
    for (const [k, positions] of frames.entries()) {
      this.frames[k].truth = new BufferAttribute(positions, 3);
    }
    const error = this.rangeOf(
      (k, i, X) => distance(X, this.frames[k].truth!.array as Float32Array, i),
      LONG_TAIL,
    );
    this.ranges.error = [0, error[1] || 1];
    this.ask();
  }

  /** Give triangles, as places of points among those shown; null takes them away. */
  setFaces(faces: Uint32Array | null): void {
    this.faces = faces;
    for (const frame of this.frames) frame.normal = null;
    this.mesh.geometry.setIndex(faces ? new BufferAttribute(faces, 1) : null);
    this.ask();
  }

  get hasFaces(): boolean {
    return this.faces !== null;
  }

  range(colouring: Colouring): [number, number] {
    return this.ranges[colouring];
  }

  get drawn(): number {
    const all = this.frames[0]?.position.count ?? 0;
    if (this.look.mesh && this.hasFaces) return all;
    return this.playing && !this.look.whole ? Math.ceil(all * this.detail) : all;
  }

  seek(time: number, playing: boolean): void {
    if (playing !== this.playing) {
      this.pictures.length = 0;
      this.adapted = performance.now();
    }
    this.time = time;
    this.playing = playing;
    if (playing) {
      this.draw(); // called once for each picture of the browser
      this.measure();
    } else {
      this.ask();
    }
  }

  /** Look from where the camera of the tracks is on average, at the whole. */
  resetView(): void {
    this.moved = false;
    const distance = this.fitting();
    this.camera.up.set(0, 1, 0);
    this.camera.position.set(0.22 * distance, 0.1 * distance, 0.97 * distance);
    this.controls.target.set(0, 0, 0);
    this.camera.near = distance / 100;
    this.camera.far = distance * 10;
    this.camera.updateProjectionMatrix();
    this.controls.update();
    this.ask();
  }

  /** Turn the view by angles, and bring it nearer by a factor. */
  turn(right: number, up: number, zoom = 1): void {
    this.moved = true;
    const { target } = this.controls;
    const offset = this.camera.position.clone().sub(target);
    const length = offset.length() * zoom;
    const azimuth = Math.atan2(offset.x, offset.z) + right;
    const polar = Math.acos(Math.min(Math.max(offset.y / offset.length(), -1), 1)) - up;
    const held = Math.min(Math.max(polar, 0.02), Math.PI - 0.02);
    offset.setFromSphericalCoords(length, held, azimuth);
    this.camera.position.copy(target).add(offset);
    this.controls.update();
    this.ask();
  }

  ask(): void {
    this.asked ||= requestAnimationFrame(() => {
      this.asked = 0;
      if (!this.playing) this.draw();
    });
  }

  dispose(): void {
    cancelAnimationFrame(this.asked);
    this.watcher.disconnect();
    this.controls.dispose();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }

  private draw(): void {
    if (!this.frames.length) return;
    const last = this.frames.length - 1;
    const low = Math.min(Math.floor(this.time), last);
    const high = Math.min(low + 1, last);
    const blend = Math.min(Math.max(this.time - low, 0), 1);
    const meshed = this.look.mesh && this.hasFaces;
    this.points.visible = !meshed;
    this.mesh.visible = meshed;
    this.bind(meshed ? this.mesh : this.points, low, high, blend);
    this.points.geometry.setDrawRange(0, this.drawn);
    this.truthPoints.visible = this.look.truth && this.frames[low].truth !== null;
    if (this.truthPoints.visible) this.bindTruth(low, high, blend);
    this.path.visible = this.look.path && this.rotations.length > 0;
    if (this.path.visible) this.placeMarker(low, high, blend);
    this.controls.enabled = !this.look.follow;
    if (this.look.follow && this.rotations.length) this.followCamera(low, high, blend);
    else this.controls.update();
    this.renderer.render(this.scene, this.camera);
  }

  private bind(
    part: Points<BufferGeometry, ShaderMaterial> | Mesh<BufferGeometry, ShaderMaterial>,
    low: number,
    high: number,
    blend: number,
  ): void {
    const { geometry, material } = part;
    const { uniforms } = material;
    const { colouring } = this.look;
    geometry.setAttribute("position", this.frames[low].position);
    geometry.setAttribute("nextPosition", this.frames[high].position);
    if (colouring === "motion" || colouring === "error") {
      geometry.setAttribute("reference", this.reference(low));
      geometry.setAttribute("nextReference", this.reference(high));
    }
    if (part === this.mesh) {
      geometry.setAttribute("normal", this.normal(low));
      geometry.setAttribute("nextNormal", this.normal(high));
    }
    uniforms.blend.value = blend;
    uniforms.mode.value = MODES[colouring];
    uniforms.range.value.set(...this.ranges[colouring]);
    const R = this.rotations[low];
    if (R) uniforms.depthAxis.value.set(R[6], R[7], R[8]).multiplyScalar(this.upward);
    uniforms.pointSize.value = this.look.pointSize * this.renderer.getPixelRatio();
    uniforms.radius.value = this.radius;
  }

  /** What the positions of a frame are compared with. */
  private reference(k: number): BufferAttribute {
    const frame = this.frames[k];
    if (this.look.colouring === "error") return frame.truth ?? frame.position;
    return this.frames[k === 0 ? Math.min(1, this.frames.length - 1) : k - 1].position;
  }

  private bindTruth(low: number, high: number, blend: number): void {
    const { geometry, material } = this.truthPoints;
    geometry.setAttribute("position", this.frames[low].truth!);
    geometry.setAttribute("nextPosition", this.frames[high].truth!);
    geometry.setDrawRange(0, this.drawn);
    material.uniforms.blend.value = blend;
    material.uniforms.pointSize.value =
      Math.max(1.5, this.look.pointSize * 0.7) * this.renderer.getPixelRatio();
    material.uniforms.radius.value = this.radius;
  }

  /** Normals of the points, found when a frame is first shown as a mesh and kept as bytes. */
  private normal(k: number): BufferAttribute {
    const frame = this.frames[k];
    frame.normal ??= new BufferAttribute(
      normalsOf(frame.position.array as Float32Array, this.faces!),
      4,
      true,
    );
    return frame.normal;
  }

  private rotationAt(low: number, high: number, blend: number): [Vector3, Vector3, Vector3] {
    const [A, B] = [this.rotations[low], this.rotations[high]];
    const mixed = (r: number) =>
      new Vector3(
        ...([0, 1, 2].map((i) => A[3 * r + i] * (1 - blend) + B[3 * r + i] * blend) as [
          number,
          number,
          number,
        ]),
      ).normalize();
    return [mixed(0), mixed(1), mixed(2)];
  }

  private followCamera(low: number, high: number, blend: number): void {
    const [, v, third] = this.rotationAt(low, high, blend);
    const turn = this.world.quaternion;
    this.camera.up.copy(v.multiplyScalar(this.upward).applyQuaternion(turn));
    this.camera.position.copy(
      third.multiplyScalar(this.upward * this.fitting()).applyQuaternion(turn),
    );
    this.camera.lookAt(0, 0, 0);
    this.camera.up.set(0, 1, 0);
  }

  /** Draw where the cameras were; made once, when first wanted. */
  private makePath(): void {
    const distance = PATH_RADII * this.radius;
    const spots = this.rotations.flatMap((R) => [6, 7, 8].map((i) => R[i] * distance));
    this.line.geometry.setAttribute("position", new BufferAttribute(Float32Array.from(spots), 3));
    this.marker.geometry.setAttribute("position", new BufferAttribute(new Float32Array(48), 3));
  }

  /** The image plane of the frame that is shown, and lines from its corners along the view. */
  private placeMarker(low: number, high: number, blend: number): void {
    if (!this.marker.geometry.attributes.position) this.makePath();
    this.line.scale.setScalar(this.upward);
    const [right, v, third] = this.rotationAt(low, high, blend);
    const middle = third.clone().multiplyScalar(this.upward * PATH_RADII * this.radius);
    const half = 0.22 * this.radius;
    const corner = (a: number, b: number) =>
      middle
        .clone()
        .addScaledVector(right, a * half * 1.3)
        .addScaledVector(v, b * half);
    const corners = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
    const eye = middle.clone().addScaledVector(third, this.upward * 0.5 * half);
    const lines = corners.flatMap((c, i) => [c, corners[(i + 1) % 4], c, eye]);
    const target = this.marker.geometry.attributes.position as BufferAttribute;
    for (const [i, spot] of lines.entries()) target.setXYZ(i, spot.x, spot.y, spot.z);
    target.needsUpdate = true;
  }

  /** Distance from which the whole fits into the picture. */
  private fitting(): number {
    const half =
      Math.tan(((this.camera.fov / 2) * Math.PI) / 180) * Math.min(1, this.camera.aspect);
    const size = this.look.path ? (PATH_RADII + 0.25) * this.radius : 1.02 * this.radius;
    return size / half;
  }

  private measureRadius(): void {
    const norms = this.sampled((_, i, X) => Math.hypot(X[i], X[i + 1], X[i + 2]));
    this.radius = norms[Math.floor(0.995 * (norms.length - 1))] || 1;
  }

  private array(k: number): Float32Array {
    return this.frames[k].position.array as Float32Array;
  }

  /** Values at some points of all frames, in order. */
  private sampled(value: (k: number, i: number, X: Float32Array) => number): Float64Array {
    const points = Math.min(this.frames[0].position.count, SAMPLE);
    const values = new Float64Array(points * this.frames.length);
    let write = 0;
    for (let k = 0; k < this.frames.length; k += 1) {
      const X = this.array(k);
      for (let j = 0; j < points; j += 1) values[write++] = value(k, 3 * j, X);
    }
    return values.sort();
  }

  /** The range that holds all values but a few outliers. */
  private rangeOf(
    value: (k: number, i: number, X: Float32Array) => number,
    part = 0.998,
  ): [number, number] {
    const values = this.sampled(value);
    const at = (where: number) => values[Math.round(where * (values.length - 1))];
    return [at(1 - part), at(part)];
  }

  private resize(): void {
    const { clientWidth, clientHeight } = this.canvas;
    if (!clientWidth || !clientHeight) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    if (!this.moved && this.frames.length) this.resetView();
    this.ask();
  }

  /** Find out how fast pictures come, and draw fewer points where they come too slowly. */
  private measure(): void {
    const now = performance.now();
    this.pictures.push(now);
    while (this.pictures.length > 2 && now - this.pictures[0] > 1500) this.pictures.shift();
    const pictures = this.pictures.length;
    if (now - this.adapted < 750 || pictures < 2 || (pictures < 5 && now - this.adapted < 1500))
      return;
    this.adapted = now;
    this.rate = (1000 * (this.pictures.length - 1)) / (now - this.pictures[0]);
    if (!(this.look.mesh && this.hasFaces) && !this.look.whole) {
      const before = this.detail;
      if (this.rate < 28) this.detail = Math.max(0.05, this.detail * Math.max(0.5, this.rate / 34));
      else if (this.rate > 38) this.detail = Math.min(1, this.detail * 1.25);
      if (this.detail !== before) this.pictures.length = 0;
    }
    this.onmeasure();
  }
}

const distance = (X: Float32Array, Y: Float32Array, i: number): number =>
  Math.hypot(X[i] - Y[i], X[i + 1] - Y[i + 1], X[i + 2] - Y[i + 2]);

/** Area-weighted normals of the points as (K, 4) signed bytes; the fourth is padding. */
function normalsOf(positions: Float32Array, faces: Uint32Array): Int8Array {
  const sums = new Float32Array(positions.length);
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [3 * faces[f], 3 * faces[f + 1], 3 * faces[f + 2]];
    const ux = positions[b] - positions[a];
    const uy = positions[b + 1] - positions[a + 1];
    const uz = positions[b + 2] - positions[a + 2];
    const vx = positions[c] - positions[a];
    const vy = positions[c + 1] - positions[a + 1];
    const vz = positions[c + 2] - positions[a + 2];
    const nx = uy * vz - uz * vy;
    const ny = uz * vx - ux * vz;
    const nz = ux * vy - uy * vx;
    for (const at of [a, b, c]) {
      sums[at] += nx;
      sums[at + 1] += ny;
      sums[at + 2] += nz;
    }
  }
  const out = new Int8Array((positions.length / 3) * 4);
  for (let i = 0, o = 0; i < sums.length; i += 3, o += 4) {
    const length = Math.hypot(sums[i], sums[i + 1], sums[i + 2]) || 1;
    out[o] = (127 * sums[i]) / length;
    out[o + 1] = (127 * sums[i + 1]) / length;
    out[o + 2] = (127 * sums[i + 2]) / length;
  }
  return out;
}

/** Whether pictures are computed by the processor, where smooth edges cost too much. */
function isSoftware(): boolean {
  const context = document.createElement("canvas").getContext("webgl2");
  const names = context?.getExtension("WEBGL_debug_renderer_info");
  const name = names ? String(context!.getParameter(names.UNMASKED_RENDERER_WEBGL)) : "";
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}
