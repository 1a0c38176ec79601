/** One job: its progress, what went wrong, or its result. */

import { isActive, type Job, save } from "../api";
import { h, icon, replace, say } from "../dom";
import { followJob } from "../events";
import { bytes, count, exact, label, precise, seconds, sentence, significant } from "../format";
import { errorPanel, problemPanel } from "../problem";
import { figuresCard } from "./figures";
import { actions, apartFromProgress, badge, batchLink, facts, title } from "./parts";

export function jobView(id: string, signal: AbortSignal): HTMLElement {
  return new JobView(id, signal).element;
}

class JobView {
  readonly element: HTMLElement;
  private readonly head = h("div", { class: "job-head" });
  private readonly problems = h("div", { class: "problems" });
  private readonly body = h("div", { class: "job-body" }, h("p", { class: "empty" }, "Loading…"));
  private progress: Progress | null = null;
  private following = new AbortController();
  /** Which result is shown; a job that ran again has another one. */
  private shown: string | null = null;
  private viewing = new AbortController();
  private said = "";

  constructor(
    private readonly id: string,
    signal: AbortSignal,
  ) {
    this.element = h("article", { class: "job" }, this.head, this.problems, this.body);
    signal.addEventListener("abort", () => {
      this.following.abort();
      this.viewing.abort();
    });
    this.follow();
  }

  private follow(): void {
    this.following.abort();
    this.following = new AbortController();
    void followJob(this.id, (job) => this.show(job), this.following.signal);
  }

  private show(job: Job | null): void {
    if (!job) {
      this.viewing.abort();
      delete this.head.dataset.text;
      replace(this.head, h("h1", {}, "No such job"));
      replace(
        this.body,
        h("p", {}, "It was deleted, its time is over, or it is another owner's."),
        h("p", {}, h("a", { href: "#/jobs" }, "All jobs")),
      );
      return;
    }
    document.title = `${title(job)} – SMSR`;
    this.drawHead(job);
    const state = `${job.status} ${job.attempt} ${job.finished_at}`;
    if (isActive(job)) {
      this.shown = null;
      this.viewing.abort();
      if (!this.progress || !this.body.contains(this.progress.element)) {
        this.progress = new Progress();
        replace(this.body, this.progress.element);
      }
      this.progress.show(job);
    } else if (this.shown !== state) {
      this.shown = state;
      this.progress = null;
      this.viewing.abort();
      this.viewing = new AbortController();
      replace(
        this.body,
        ended(job, this.viewing.signal, (error) => this.fail(error)),
      );
    }
    const news = `${title(job)}: ${job.status}`;
    if (news !== this.said) say(news);
    this.said = news;
  }

  private fail(error: unknown): void {
    replace(this.problems, errorPanel(error));
  }

  private drawHead(job: Job): void {
    const text = apartFromProgress(job);
    if (this.head.dataset.text === text) {
      this.head.querySelector(".badge")?.replaceWith(badge(job));
      return;
    }
    this.head.dataset.text = text;
    const held = document.activeElement?.closest(".job-head") ? document.activeElement : null;
    const name = held?.getAttribute("title");
    const parts = [
      job.frames && job.points
        ? `${count(job.frames)} frames of ${count(job.points)} points`
        : null,
      `sent ${exact(job.created_at)}`,
      job.timings.total !== undefined ? `took ${seconds(job.timings.total)}` : null,
      job.attempt > 1 ? `attempt ${job.attempt}` : null,
    ].filter((part) => part !== null);
    replace(
      this.head,
      h(
        "div",
        {},
        h("h1", {}, title(job), " ", badge(job)),
        h(
          "p",
          { class: "facts" },
          parts.join(" · "),
          job.batch ? [" · batch ", batchLink(job.batch)] : null,
        ),
      ),
      h(
        "div",
        { class: "row", role: "group", "aria-label": "Actions" },
        actions(job, {
          changed: (changed) => {
            this.problems.replaceChildren();
            this.show(changed);
            this.follow();
          },
          gone: () => {
            location.hash = "#/jobs";
          },
          failed: (error) => this.fail(error),
        }),
      ),
    );
    if (name) this.head.querySelector<HTMLElement>(`[title="${name}"]`)?.focus();
  }
}

/** The stages of a run in the usual order; a run may leave some out. */
const STAGES: Record<string, string> = {
  opening: "opening the files",
  reading: "reading the tracks",
  factorising: "reducing to virtual points",
  scales: "finding the scale of the camera",
  cameras: "finding the cameras",
  smoothing: "smoothing the tracks",
  shapes: "finding the shapes",
  writing: "writing the result",
  evaluating: "comparing with the ground truth",
  publishing: "keeping the result",
};

class Progress {
  private readonly bar = h("progress", { max: 1, "aria-label": "Progress of the job" });
  private readonly percent = h("strong", { class: "percent" });
  private readonly stage = h("p", { class: "stage-name", role: "status" });
  private readonly detail = h("p", { class: "help" });
  readonly element = h(
    "section",
    { class: "card progress", "aria-label": "Progress" },
    h("div", { class: "row" }, this.stage, this.percent),
    this.bar,
    this.detail,
  );

  show(job: Job): void {
    const { progress } = job;
    if (job.status === "queued" || !progress) {
      this.bar.removeAttribute("value");
      this.percent.textContent = "";
      const before = job.queue_position;
      this.put(
        job.status === "running"
          ? "A worker has begun."
          : before
            ? `Waiting: ${count(before)} ${before === 1 ? "job is" : "jobs are"} before this one.`
            : "Waiting for a worker.",
      );
      this.detail.textContent = "";
      return;
    }
    this.bar.value = progress.fraction;
    this.percent.textContent = `${Math.round(100 * progress.fraction)} %`;
    this.put(sentence(STAGES[progress.stage] ?? label(progress.stage)));
    const parts = [];
    if (progress.iteration) parts.push(`iteration ${count(progress.iteration)}`);
    if (progress.residual !== null) parts.push(`residual ${significant(progress.residual)}`);
    this.detail.textContent = parts.join(", ");
  }

  private put(text: string): void {
    if (this.stage.textContent !== text) this.stage.textContent = text;
  }
}

function ended(job: Job, signal: AbortSignal, fail: (error: unknown) => void): Node[] {
  if (job.status === "failed") {
    return [
      problemPanel(
        job.problem ?? { type: "about:blank", title: "The job failed", status: 500, detail: null },
      ),
      optionsCard(job),
    ];
  }
  if (job.status === "cancelled") {
    return [
      h("p", { class: "notice" }, "The job was cancelled and has no result."),
      optionsCard(job),
    ];
  }
  const place = h("div", { class: "viewer-place" }, h("p", { class: "empty" }, "Loading…"));
  if (job.links.shapes) {
    // three.js is fetched here, when it is wanted for the first time.
    void import("../viewer/viewer").then(
      ({ viewer }) => {
        if (!signal.aborted) replace(place, viewer(job, signal));
      },
      () => replace(place, h("p", { class: "notice" }, "The viewer cannot be loaded.")),
    );
  } else {
    replace(place, h("p", { class: "notice" }, "This service has no arrays for the viewer."));
  }
  const cautions = job.diagnostics?.cautions ?? [];
  return [
    cautions.length
      ? h(
          "div",
          { class: "cautions", role: "note" },
          h(
            "h2",
            {},
            cautions.length === 1 ? "A weakness of this input" : "Weaknesses of this input",
          ),
          h(
            "ul",
            {},
            cautions.map((caution) => h("li", {}, sentence(caution.message))),
          ),
        )
      : h("span", { hidden: true }),
    place,
    h("div", { class: "cards" }, accuracyCard(job), downloadsCard(job, fail), optionsCard(job)),
    job.links.figure
      ? figuresCard(
          () => `${job.links.figure}?image_v=${viewed("imageV") ?? "auto"}`,
          stemOf(job),
          job.metrics !== null,
          signal,
        )
      : h("span", { hidden: true }),
  ];
}

function accuracyCard(job: Job): HTMLElement {
  const { metrics, diagnostics } = job;
  return h(
    "section",
    { class: "card" },
    h("h2", {}, "Result"),
    metrics
      ? h(
          "p",
          { class: "headline" },
          h("strong", { class: "e3d" }, precise(metrics.e3d)),
          h("span", {}, " e3D, the mean error in σ of the ground truth"),
        )
      : null,
    facts([
      ["Each frame aligned", metrics?.e3d_per_frame ? precise(metrics.e3d_per_frame) : null],
      ["Compared in", metrics?.frame ? `the ${metrics.frame} frame` : null],
      ["Scale fitted", metrics?.scale && metrics.scale !== 1 ? precise(metrics.scale) : null],
      ["Camera", diagnostics?.camera_model],
      ["Basis shapes", diagnostics ? String(diagnostics.basis_size) : null],
      ["Converged", diagnostics ? (diagnostics.converged ? "yes" : "no") : null],
      ["In the queue", job.timings.queued !== undefined ? seconds(job.timings.queued) : null],
    ]),
  );
}

/** What the viewer shows: the number of the frame, or where the image's v grows to. */
const viewed = (what: "frame" | "imageV"): string | undefined =>
  document.querySelector<HTMLElement>(".viewer")?.dataset[what];

/** Name of a job in names of files. */
const stemOf = (job: Job): string =>
  title(job)
    .replace(/\.(npy|npz|mat|csv|txt)(\.gz)?$/i, "")
    .replace(/\W+/g, "-");

function downloadsCard(job: Job, fail: (error: unknown) => void): HTMLElement {
  const { links } = job;
  const stem = stemOf(job);
  const button = (path: string | (() => string), name: string, text: string, help: string) => {
    const element = h(
      "button",
      { type: "button", class: "download", "data-file": name },
      icon("down"),
      h("span", {}, text, h("small", {}, help)),
    );
    const find = typeof path === "string" ? () => path : path;
    element.addEventListener("click", () => void save(find(), name).catch(fail));
    return element;
  };
  const frame = h("button", { type: "button", class: "download", "data-file": "frame" });
  replace(frame, icon("down"), h("span", {}, "PLY", h("small", {}, "the frame that is shown")));
  frame.addEventListener("click", () => {
    const t = viewed("frame") ?? "0";
    void save(links.frame!.replace("{t}", t), `${stem}-frame-${t.padStart(4, "0")}.ply`).catch(
      fail,
    );
  });
  const size = job.frames && job.points ? `, ${bytes(12 * job.frames * job.points)}` : "";
  return h(
    "section",
    { class: "card" },
    h("h2", {}, "Downloads"),
    h(
      "div",
      { class: "downloads" },
      links.result ? button(links.result, `${stem}.npz`, "NPZ", `all arrays${size}`) : null,
      links.frames ? button(links.frames, `${stem}-frames.zip`, "ZIP", "all frames as PLY") : null,
      links.frame ? frame : null,
      links.glb
        ? button(
            () => `${links.glb}?image_v=${viewed("imageV") ?? "auto"}`,
            `${stem}.glb`,
            "GLB",
            "animated, for Blender and others",
          )
        : null,
      links.report
        ? button(links.report, `${stem}-report.json`, "Report", "how it came about")
        : null,
    ),
    h(
      "p",
      { class: "help" },
      h(
        "button",
        {
          type: "button",
          class: "link",
          onclick: () => void save(links.self!, `${stem}-job.json`).catch(fail),
        },
        "This job as JSON",
      ),
      job.expires_at ? ` · kept until ${exact(job.expires_at)}` : "",
    ),
  );
}

function optionsCard(job: Job): HTMLElement {
  const files = Object.entries(job.inputs).map(([role, file]): [string, string] => [
    label(role),
    `${file.name}, ${bytes(file.bytes)}`,
  ]);
  const options = Object.entries(job.options)
    .filter(([, value]) => value !== null)
    .map(([name, value]): [string, string] => [label(name), String(value)]);
  return h(
    "section",
    { class: "card" },
    h("h2", {}, "Input"),
    facts(files),
    h("details", {}, h("summary", {}, "Options in force"), facts(options)),
  );
}
