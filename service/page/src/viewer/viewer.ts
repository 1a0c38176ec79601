/** The viewer of a result: the surface, the tracks it came from, and time to move through. */

import type { Job, Metrics } from "../api";
import { alignTruth } from "../data/alignment";
import type { Tracks } from "../data/tracks";
import { growsUp, type Layout, tracksOf } from "../data/tracks";
import { TrackView } from "../data/trackview";
import { append, h, icon, reducedMotion, replace, say, svg } from "../dom";
import { bytes, count, significant } from "../format";
import { Player } from "../player";
import { ticks } from "./colours";
import { fetchArray, fetchInput, fetchShapes, type Plan, projected } from "./result";
import { type Colouring, Scene } from "./scene";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];
const COLOURINGS: Record<Colouring, string> = {
  depth: "Depth",
  motion: "3D motion",
  error: "Error to ground truth",
  plain: "One colour",
};
const LEGENDS: Record<Colouring, string> = {
  depth: "Depth towards the camera (unit of the tracks)",
  motion: "3D motion in a frame (unit of the tracks)",
  error: "Distance from the ground truth (σ, as e3D)",
  plain: "",
};

/** Points that any browser draws fast enough. */
const FEW = 10_000;

const KEYS: [string, string][] = [
  ["Space", "play or pause"],
  ["← →", "a frame back or on; ten with Shift"],
  ["Home, End", "first or last frame"],
  ["W A S D", "turn the view"],
  ["+ −", "nearer or farther"],
  ["R", "first view again"],
  ["C", "next colouring"],
  ["M", "points or mesh"],
];

/** Show the result of a job; returns the element at once, which fills as data arrive. */
export function viewer(job: Job, signal: AbortSignal): HTMLElement {
  return new Viewer(job, signal).element;
}

class Viewer {
  readonly element: HTMLElement;
  private readonly player = new Player();
  private readonly scene: Scene | null = null;
  private readonly canvas = h("canvas", {
    class: "surface",
    tabindex: 0,
    role: "img",
    "aria-label": "The surface in 3D. Drag to turn it; W, A, S and D turn it by keyboard.",
  });
  private readonly trackCanvas = h("canvas", {
    class: "tracks",
    role: "img",
    "aria-label": "The tracks of the shown frame in the image",
  });
  private readonly trackTitle = h("span", {}, "Input tracks");
  private readonly trackView = new TrackView(this.trackCanvas);
  private readonly loading = h("progress", {
    max: 1,
    value: 0,
    "aria-label": "Loading the result",
  });
  private readonly note = h("p", { class: "stage-note", role: "status" });
  private readonly measured = h("span", { class: "measured", "aria-hidden": "true" });
  private readonly legend = h("div", { class: "legend", role: "img" });
  private readonly slider = h("input", {
    type: "range",
    class: "scrub",
    min: "0",
    max: "0",
    step: "1",
    value: "0",
    "aria-label": "Frame",
  });
  private readonly playButton = h("button", { class: "play", type: "button" });
  private readonly frameLabel = h("output", { class: "frame-label" });
  private readonly errorPlot = h("div", { class: "error-plot", hidden: true });
  private cursor: SVGElement | null = null;
  private readonly colourSelect = h("select", { id: "colour" });
  private readonly meshBox = h("input", { type: "checkbox", id: "mesh" });
  private readonly triangulateBox = h("input", { type: "checkbox", id: "triangulate" });
  private readonly triangulateRow: HTMLElement;
  private readonly truthBox = h("input", { type: "checkbox", id: "truth" });
  private readonly truthRow: HTMLElement;
  private readonly wholeBox = h("input", { type: "checkbox", id: "whole" });
  private readonly wholeRow: HTMLElement;
  private readonly upBox = h("input", { type: "checkbox", id: "up" });
  private plan: Plan | null = null;
  private readonly shapes: Float32Array[] = [];
  private cameras: ArrayLike<number> = [];
  private translations: ArrayLike<number> = [];
  private tracks: Tracks | null = null;
  private sigma = 1;
  private errors: number[] | null = null;
  private facesGiven: Uint32Array | null = null;
  private facesFound: Uint32Array | null = null;
  private decimation = "";

  constructor(
    private readonly job: Job,
    private readonly signal: AbortSignal,
  ) {
    this.triangulateRow = this.check(
      this.triangulateBox,
      "Triangulate the points",
      "no faces sent",
    );
    this.truthRow = this.check(this.truthBox, "Overlay ground truth", "orange points");
    this.wholeRow = this.check(this.wholeBox, "All points, however slow");
    this.element = this.build();
    try {
      this.scene = new Scene(this.canvas);
    } catch {
      replace(
        this.element,
        h(
          "p",
          { class: "notice" },
          "This browser draws no 3D (WebGL 2 is off or missing). The downloads work all the same.",
        ),
      );
      return;
    }
    this.wire(this.scene);
    signal.addEventListener("abort", () => {
      this.player.pause();
      this.trackView.dispose();
      this.scene?.dispose();
    });
    void this.load(this.scene).catch((error) => {
      if (!signal.aborted) this.tell(`The result cannot be shown: ${(error as Error).message}`);
    });
  }

  // What is seen

  private build(): HTMLElement {
    for (const [value, text] of Object.entries(COLOURINGS)) {
      if (value !== "error") append(this.colourSelect, h("option", { value }, text));
    }
    const speeds = h("select", { id: "speed", class: "speed", "aria-label": "Speed" });
    for (const speed of SPEEDS) {
      append(speeds, h("option", { value: speed, selected: speed === 1 }, `${speed}×`));
    }
    speeds.addEventListener("change", () => {
      this.player.speed = Number(speeds.value);
    });
    const step = (name: string, label: string, by: number) =>
      h(
        "button",
        {
          type: "button",
          class: "quiet",
          "aria-label": label,
          onclick: () => this.player.step(by),
        },
        icon(name),
      );
    const size = h("input", { type: "range", id: "size", min: 1, max: 12, step: 0.5, value: 3 });
    size.id = "size";
    size.addEventListener("input", () => this.restyle({ pointSize: Number(size.value) }));
    this.sizeInput = size;
    const path = h("input", { type: "checkbox", id: "path" });
    path.addEventListener("change", () => {
      this.restyle({ path: path.checked });
      this.scene?.resetView();
    });
    const follow = h("input", { type: "checkbox", id: "follow" });
    follow.addEventListener("change", () => {
      this.restyle({ follow: follow.checked });
      if (!follow.checked) this.scene?.resetView();
    });
    this.triangulateRow.hidden = true;
    this.truthRow.hidden = true;
    this.wholeRow.hidden = true;
    const keys = h(
      "details",
      { class: "keys" },
      h("summary", {}, "Keyboard"),
      h(
        "dl",
        {},
        KEYS.flatMap(([key, what]) => [h("dt", {}, h("kbd", {}, key)), h("dd", {}, what)]),
      ),
    );
    return h(
      "section",
      { class: "viewer", "aria-label": "Viewer" },
      h(
        "div",
        { class: "stages" },
        h(
          "figure",
          { class: "stage stage-3d" },
          this.canvas,
          h("figcaption", {}, h("span", {}, "Reconstruction"), this.measured),
          this.legend,
          this.loading,
          this.note,
          h(
            "button",
            {
              type: "button",
              class: "stage-button",
              "aria-label": "Reset the view",
              title: "Reset the view (R)",
              onclick: () => this.scene?.resetView(),
            },
            icon("view"),
          ),
        ),
        h(
          "figure",
          { class: "stage stage-2d" },
          this.trackCanvas,
          h("figcaption", {}, this.trackTitle),
        ),
      ),
      h(
        "div",
        { class: "transport", role: "group", "aria-label": "Time" },
        this.playButton,
        step("back", "Frame back", -1),
        step("forward", "Frame on", 1),
        h("div", { class: "timeline" }, this.errorPlot, this.slider),
        this.frameLabel,
        speeds,
      ),
      h(
        "div",
        { class: "settings", role: "group", "aria-label": "How it is shown" },
        h(
          "label",
          { class: "field", for: "colour" },
          h("span", {}, "Colour by"),
          this.colourSelect,
        ),
        h("label", { class: "field", for: "size" }, h("span", {}, "Point size"), size),
        h(
          "div",
          { class: "checks" },
          this.check(this.meshBox, "Shaded mesh"),
          this.triangulateRow,
          this.truthRow,
          this.check(path, "Camera path"),
          this.check(follow, "See as the camera"),
          this.check(this.upBox, "Image v grows upwards"),
          this.wholeRow,
        ),
        keys,
      ),
    );
  }

  private sizeInput: HTMLInputElement | null = null;

  private check(box: HTMLInputElement, text: string, hint?: string): HTMLElement {
    return h(
      "label",
      { class: "check", for: box.id },
      box,
      h("span", {}, text, hint ? h("small", {}, ` (${hint})`) : null),
    );
  }

  private wire(scene: Scene): void {
    this.playButton.addEventListener("click", () => this.player.toggle());
    this.slider.addEventListener("input", () => this.player.seek(Number(this.slider.value)));
    this.colourSelect.addEventListener("change", () =>
      this.restyle({ colouring: this.colourSelect.value as Colouring }),
    );
    this.meshBox.disabled = true;
    this.meshBox.addEventListener("change", () => this.restyle({ mesh: this.meshBox.checked }));
    this.triangulateBox.addEventListener("change", () => void this.triangulate());
    this.truthBox.addEventListener("change", () => this.restyle({ truth: this.truthBox.checked }));
    this.upBox.addEventListener("change", () => this.setUpward(scene, this.upBox.checked));
    this.wholeBox.addEventListener("change", () => this.restyle({ whole: this.wholeBox.checked }));
    this.player.onchange = () => this.follow();
    scene.onmeasure = () => this.showRate();
    document.addEventListener("keydown", (event) => this.onkey(event), { signal: this.signal });
    document.addEventListener(
      "visibilitychange",
      () => {
        if (document.hidden) this.player.pause();
      },
      { signal: this.signal },
    );
    this.follow();
  }

  /** Bring all that shows time to the present frame. */
  private follow(): void {
    const { player, scene } = this;
    if (!scene) return;
    const { frame, playing } = player;
    scene.seek(player.time, playing);
    this.trackView.seek(frame, playing);
    this.slider.value = String(frame);
    const number = this.plan ? this.plan.frameNumbers[frame] : 0;
    const total = this.plan?.frames ?? 1;
    const text = `${number + 1} / ${total}`;
    if (this.frameLabel.textContent !== text) {
      this.frameLabel.textContent = text;
      this.slider.setAttribute("aria-valuetext", this.valueText(number, total, frame));
      this.cursor?.setAttribute("x1", String(frame));
      this.cursor?.setAttribute("x2", String(frame));
    }
    this.element.dataset.frame = String(number);
    const name = playing ? "Pause" : "Play";
    if (this.playButton.getAttribute("aria-label") !== name) {
      this.playButton.setAttribute("aria-label", name);
      this.playButton.title = `${name} (Space)`;
      replace(this.playButton, icon(playing ? "pause" : "play"));
      this.showRate();
    }
  }

  private valueText(number: number, total: number, frame: number): string {
    const error = this.errors ? `, error ${significant(this.errors[frame])}` : "";
    return `Frame ${number + 1} of ${total}${error}`;
  }

  private showRate(): void {
    const { scene, player } = this;
    if (!scene) return;
    const part = scene.drawn / (this.shapes[0]?.length / 3 || 1);
    const thinned = part < 0.995 ? `, ${Math.round(100 * part)} % of the points` : "";
    this.measured.textContent =
      player.playing && scene.rate ? `${Math.round(scene.rate)} pictures/s${thinned}` : "";
    this.canvas.dataset.rate = scene.rate.toFixed(1);
    this.canvas.dataset.drawn = String(scene.drawn);
  }

  private restyle(change: Partial<Scene["look"]>): void {
    const { scene } = this;
    if (!scene) return;
    Object.assign(scene.look, change);
    this.drawLegend();
    scene.ask();
  }

  private drawLegend(): void {
    const { colouring } = this.scene!.look;
    this.legend.hidden = colouring === "plain" || !this.plan;
    this.element.dataset.colouring = colouring;
    if (this.legend.hidden) return;
    const unit = colouring === "error" ? this.sigma : 1;
    const [low, high] = this.scene!.range(colouring).map((value) => value / unit);
    const marks = ticks(low, high).map((value) => {
      const mark = h("span", { class: "tick" }, significant(value, 4).replace("-", "−"));
      mark.style.left = `${(100 * (value - low)) / (high - low || 1)}%`;
      return mark;
    });
    replace(
      this.legend,
      h("span", { class: "legend-title" }, LEGENDS[colouring]),
      h("span", { class: "legend-ramp" }),
      h("span", { class: "legend-ticks" }, marks),
    );
    this.legend.setAttribute(
      "aria-label",
      `${LEGENDS[colouring]}: from ${significant(low)} (dark violet) to ${significant(high)} (yellow)`,
    );
  }

  private tell(text: string): void {
    this.note.textContent = text;
    say(text);
  }

  // What is loaded

  private async load(scene: Scene): Promise<void> {
    const { job, signal } = this;
    const [cameras, translations] = await Promise.all([
      fetchArray(job.links.cameras!, signal),
      fetchArray(job.links.translations!, signal),
    ]);
    this.cameras = cameras.data;
    this.translations = translations.data;
    for await (const part of fetchShapes(job, signal)) {
      if (part instanceof Float32Array) this.take(part, scene);
      else this.begin(part, scene);
    }
    scene.complete();
    this.loading.hidden = true;
    this.tell(this.decimation);
    this.drawLegend();
    this.element.dataset.loaded = "true";
    if (!reducedMotion()) this.player.play();
    await this.loadTracks();
    await this.loadFaces();
    await this.loadTruth(scene);
    this.element.dataset.complete = "true";
  }

  private begin(plan: Plan, scene: Scene): void {
    this.plan = plan;
    scene.setCameras(this.cameras, plan.frameNumbers);
    const shown = plan.pointNumbers.length;
    const parts = [];
    if (shown < plan.points) parts.push(`${count(shown)} of ${count(plan.points)} points`);
    if (plan.stride > 1) parts.push(`1 in ${plan.stride} frames`);
    if (parts.length) {
      const size = bytes(12 * plan.frames * plan.points);
      this.decimation = `Shows ${parts.join(" and ")} of this large result (${size}).`;
      this.tell(this.decimation);
    }
    this.wholeRow.hidden = shown < FEW;
    const suggested = shown < 120 ? 9 : shown < 2500 ? 6 : shown < 25_000 ? 3 : 2;
    scene.look.pointSize = suggested;
    if (this.sizeInput) this.sizeInput.value = String(suggested);
  }

  private take(positions: Float32Array, scene: Scene): void {
    this.shapes.push(positions);
    if (this.shapes.length === 1) this.setUpward(scene, growsUp(this.projected()));
    scene.addFrame(positions);
    this.player.frames = this.shapes.length;
    this.slider.max = String(this.shapes.length - 1);
    this.loading.value = this.shapes.length / this.plan!.frameNumbers.length;
    if (this.shapes.length === 1) this.follow();
  }

  /** Turn both views so that they stand upright. */
  private setUpward(scene: Scene, upward: boolean): void {
    this.upBox.checked = upward;
    this.element.dataset.imageV = upward ? "up" : "down";
    scene.setUpward(upward);
    this.trackView.show(this.tracks, upward);
    this.drawLegend();
  }

  private projected(): Tracks {
    return projected(this.shapes, this.plan!.frameNumbers, this.cameras, this.translations);
  }

  private async loadTracks(): Promise<void> {
    const sent = await fetchInput(this.job, "measurements", this.signal);
    let tracks: Tracks | null = null;
    if (typeof sent !== "string") {
      tracks = tracksOf(sent, (this.job.options.layout as Layout | undefined) ?? "auto");
      if (tracks && tracks.frames !== this.plan!.frames) tracks = null;
      if (tracks && this.plan!.stride > 1) tracks = null;
    }
    if (!tracks) {
      tracks = this.projected();
      this.trackTitle.textContent = "Result, projected to the image";
      this.trackTitle.title = typeof sent === "string" ? sent : "";
    }
    if (this.signal.aborted) return;
    this.tracks = tracks;
    this.trackView.show(tracks, this.upBox.checked);
  }

  private async loadFaces(): Promise<void> {
    const { job, plan } = this;
    const whole = plan!.pointNumbers.length === plan!.points;
    const path = job.links.faces;
    if (path && whole) {
      const faces = await fetchArray(path, this.signal);
      const place = new Uint32Array(plan!.points);
      for (let j = 0; j < plan!.pointNumbers.length; j += 1) place[plan!.pointNumbers[j]] = j;
      this.facesGiven = Uint32Array.from(faces.data as ArrayLike<number>, (i) => place[i]);
      this.useFaces(this.facesGiven, true);
    } else {
      this.triangulateRow.hidden = false;
    }
  }

  private useFaces(faces: Uint32Array | null, show: boolean): void {
    this.scene!.setFaces(faces);
    this.meshBox.disabled = faces === null;
    this.meshBox.checked = show && faces !== null;
    this.restyle({ mesh: this.meshBox.checked });
  }

  /** Triangulate the mean position of the points in the image of the mean camera (Delaunay). */
  private async triangulate(): Promise<void> {
    if (!this.triangulateBox.checked) return this.useFaces(null, false);
    if (!this.facesFound) {
      this.tell("Triangulating…");
      const { meanViewTriangles } = await import("./triangles");
      this.facesFound = meanViewTriangles(this.shapes, this.plan!.frameNumbers, this.cameras);
    }
    this.tell(
      "The mesh is a triangulation of the points as the mean camera sees them; it was not sent.",
    );
    this.useFaces(this.facesFound, true);
  }

  private async loadTruth(scene: Scene): Promise<void> {
    const { job, plan } = this;
    if (!job.inputs.ground_truth) return;
    const truth = await fetchInput(job, "ground_truth", this.signal);
    if (this.signal.aborted) return;
    if (typeof truth === "string") return this.tell(`The ground truth is not shown. ${truth}`);
    const aligned = alignTruth(
      truth,
      { frames: plan!.frames, points: plan!.points },
      {
        shapes: this.shapes,
        frameNumbers: plan!.frameNumbers,
        pointNumbers: plan!.pointNumbers,
      },
      this.cameras,
      job.metrics?.frame ?? "object",
    );
    if (!aligned) return this.tell("The ground truth has other frames or points than the result.");
    scene.setTruth(aligned.frames);
    this.sigma = aligned.sigma;
    this.errors = errorsOf(job.metrics, plan!) ?? aligned.errors;
    this.element.dataset.errors = JSON.stringify(aligned.errors.map((e) => Number(e.toFixed(6))));
    this.truthRow.hidden = false;
    append(this.colourSelect, h("option", { value: "error" }, COLOURINGS.error));
    this.plotErrors(this.errors);
  }

  /** Draw the error of every frame above the slider. */
  private plotErrors(errors: number[]): void {
    const most = Math.max(...errors);
    const path = errors
      .map((e, k) => `${k ? "L" : "M"}${k} ${(100 - (92 * e) / (most || 1)).toFixed(2)}`)
      .join("");
    const wide = Math.max(errors.length - 1, 1);
    this.cursor = svg("line", { class: "plot-cursor", x1: 0, x2: 0, y1: 0, y2: 100 }) as SVGElement;
    const area = `${path}L${wide} 100L0 100Z`;
    const drawing = svg(
      "svg",
      { viewBox: `0 0 ${wide} 100`, preserveAspectRatio: "none" },
      svg("path", { d: area, class: "plot-area" }),
      svg("path", { d: path, class: "plot-line", "vector-effect": "non-scaling-stroke" }),
      this.cursor,
    );
    this.cursor.setAttribute("vector-effect", "non-scaling-stroke");
    replace(this.errorPlot, drawing);
    this.errorPlot.setAttribute("role", "img");
    this.errorPlot.setAttribute(
      "aria-label",
      `Error of each frame, at most ${significant(most)} in frame ${errors.indexOf(most) + 1}`,
    );
    this.errorPlot.title = `Error of each frame; the highest is ${significant(most)}`;
    this.errorPlot.hidden = false;
    this.follow();
  }

  // Keys

  private onkey(event: KeyboardEvent): void {
    const target = event.target as HTMLElement;
    const inside = this.element.contains(target) || target === document.body;
    if (!inside || event.ctrlKey || event.altKey || event.metaKey) return;
    const own = target.closest("select, textarea, input:not([type=checkbox]), summary, a");
    const slider = target === this.slider;
    if (own && !slider) return;
    const presses = target.closest("button, input[type=checkbox]") !== null;
    if (event.key === " " && presses) return;
    const turn = Math.PI / 24;
    const actions: Record<string, () => void> = {
      " ": () => this.player.toggle(),
      ArrowLeft: () => this.player.step(event.shiftKey ? -10 : -1),
      ArrowRight: () => this.player.step(event.shiftKey ? 10 : 1),
      Home: () => this.player.seek(0),
      End: () => this.player.seek(this.player.frames - 1),
      a: () => this.scene?.turn(-turn, 0),
      d: () => this.scene?.turn(turn, 0),
      w: () => this.scene?.turn(0, turn),
      s: () => this.scene?.turn(0, -turn),
      "+": () => this.scene?.turn(0, 0, 1 / 1.15),
      "=": () => this.scene?.turn(0, 0, 1 / 1.15),
      "-": () => this.scene?.turn(0, 0, 1.15),
      r: () => this.scene?.resetView(),
      m: () => this.meshBox.click(),
      c: () => this.nextColouring(),
    };
    const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action || (target === document.body && (event.key === "Home" || event.key === "End")))
      return;
    event.preventDefault();
    action();
  }

  private nextColouring(): void {
    const { options, selectedIndex } = this.colourSelect;
    this.colourSelect.selectedIndex = (selectedIndex + 1) % options.length;
    this.colourSelect.dispatchEvent(new Event("change"));
    say(`Coloured by ${this.colourSelect.selectedOptions[0].textContent}`);
  }
}

/** The service's own errors of the shown frames, where the document has them. */
function errorsOf(metrics: Metrics | null, plan: Plan): number[] | null {
  const all = metrics?.per_frame;
  return all?.length === plan.frames ? Array.from(plan.frameNumbers, (t) => all[t]) : null;
}
