/** A new job: files, a look at them, options, and off. */

import { connection, info, type Job } from "../api";
import { exampleFiles } from "../data/example";
import { type Inspected, inspect } from "../data/files";
import { guessRoles, misfit, ROLE_NAMES, ROLES, type Role } from "../data/roles";
import { extentOf, growsUp, type Layout, tracksOf } from "../data/tracks";
import { TrackView } from "../data/trackview";
import { append, h, icon, reducedMotion, replace, say } from "../dom";
import { bytes, count, significant } from "../format";
import { type OptionForm, optionForm } from "../options";
import { Player } from "../player";
import { errorPanel } from "../problem";
import { submit } from "../upload";

interface Chosen {
  file: File;
  role: Role | null;
  inspected: Inspected;
}

export function submitView(signal: AbortSignal): HTMLElement {
  return new SubmitView(signal).element;
}

class SubmitView {
  readonly element: HTMLElement;
  private chosen: Chosen[] = [];
  private form: OptionForm | null = null;
  /** Bytes that the service takes at once. */
  private most = Infinity;
  private readonly input = h("input", {
    type: "file",
    multiple: true,
    id: "files",
    class: "only-heard",
  });
  private readonly drop: HTMLElement;
  private readonly list = h("ul", { class: "files", "aria-label": "Chosen files" });
  private readonly preview = h("div", { class: "preview", hidden: true });
  private readonly previewNote = h("p", { class: "note", role: "status" });
  private readonly caption = h("figcaption", {});
  private readonly optionArea = h("div", {});
  private readonly batch = h("input", {
    type: "text",
    id: "batch",
    pattern: "[A-Za-z0-9][A-Za-z0-9._\\-]{0,63}",
    autocomplete: "off",
    "aria-describedby": "batch-help",
  });
  private readonly priority = h("select", { id: "priority", "aria-describedby": "priority-help" });
  private readonly settings = this.settingsForm();
  private readonly problems = h("div", { class: "problems" });
  private readonly send = h("button", { type: "submit", class: "primary", disabled: true });
  private readonly sending = h("div", { class: "sending", hidden: true });
  private readonly hint = h("p", { class: "hint", id: "send-hint" });
  private readonly player = new Player();
  private readonly canvas = h("canvas", {
    class: "tracks",
    role: "img",
    "aria-label": "Preview of the tracks",
  });
  private readonly trackView = new TrackView(this.canvas);

  constructor(private readonly signal: AbortSignal) {
    this.drop = this.dropZone();
    replace(this.send, icon("upload"), "Send");
    this.element = h(
      "form",
      { class: "submit card", "aria-labelledby": "new-title", novalidate: false },
      h("h1", { id: "new-title" }, "New job"),
      this.drop,
      this.list,
      this.preview,
      this.optionArea,
      this.settings,
      this.problems,
      h("div", { class: "send-row" }, this.send, this.hint, this.sending),
    );
    this.element.addEventListener("submit", (event) => {
      event.preventDefault();
      void this.start();
    });
    signal.addEventListener("abort", () => {
      this.player.pause();
      this.trackView.dispose();
    });
    this.buildPreview();
    this.update();
    const again = () => {
      if (!connection.lost && !this.form) void this.loadOptions();
    };
    connection.onchange.add(again);
    signal.addEventListener("abort", () => connection.onchange.delete(again));
    void this.loadOptions();
  }

  private async loadOptions(): Promise<void> {
    try {
      const known = await info();
      this.problems.replaceChildren();
      this.most = known.limits.upload_bytes;
      this.input.accept = known.formats.measurements.map((name) => `.${name}`).join(",");
      this.form = optionForm(known.options);
      this.form.onchange = (name) => {
        if (name === "layout") this.showPreview();
        if (name === "missing") this.warn();
      };
      replace(this.optionArea, h("h2", {}, "Options"), this.form.element);
      if (this.chosen.length) this.update();
    } catch (error) {
      replace(this.problems, errorPanel(error));
    }
  }

  private settingsForm(): HTMLDetailsElement {
    for (const value of ["high", "normal", "low"]) {
      append(this.priority, h("option", { value, selected: value === "normal" }, value));
    }
    const field = (name: string, control: HTMLElement, help: string) =>
      h(
        "div",
        { class: "option" },
        h("label", { for: control.id }, name),
        control,
        h("p", { class: "help", id: `${control.id}-help` }, help),
      );
    return h(
      "details",
      {},
      h("summary", {}, "Batch and priority"),
      h(
        "div",
        { class: "option-grid" },
        field(
          "Batch",
          this.batch,
          "A label that jobs share, to be followed, cancelled, run again or downloaded together: " +
            "letters, digits, dots, dashes.",
        ),
        field("Priority", this.priority, "Jobs of a higher priority are run first."),
      ),
    );
  }

  private dropZone(): HTMLElement {
    const example = h("button", { type: "button", class: "link" }, "try a generated example");
    example.addEventListener("click", () => void this.add(exampleFiles()));
    const zone = h(
      "div",
      { class: "drop", "data-drop": "true" },
      icon("upload"),
      h(
        "p",
        {},
        h("strong", {}, "Drop files here"),
        " or ",
        h("label", { class: "button", for: "files" }, "choose files"),
        this.input,
      ),
      h(
        "p",
        { class: "help" },
        "2D tracks of a deforming object; ground truth and faces where you have them. ",
        ".npy, .npz, .mat, .csv, .txt – or ",
        example,
        ".",
      ),
    );
    this.input.addEventListener("change", () => {
      void this.add([...(this.input.files ?? [])]);
      this.input.value = "";
    });
    // The whole window takes files: a drop beside the zone must not leave the page.
    const options = { signal: this.signal };
    let depth = 0;
    addEventListener(
      "dragenter",
      () => {
        depth += 1;
        zone.classList.add("over");
      },
      options,
    );
    addEventListener(
      "dragleave",
      () => {
        depth -= 1;
        if (depth <= 0) zone.classList.remove("over");
      },
      options,
    );
    addEventListener("dragover", (event) => event.preventDefault(), options);
    addEventListener(
      "drop",
      (event) => {
        event.preventDefault();
        depth = 0;
        zone.classList.remove("over");
        void this.add([...(event.dataTransfer?.files ?? [])]);
      },
      options,
    );
    return zone;
  }

  private async add(files: File[]): Promise<void> {
    if (!files.length) return;
    this.problems.replaceChildren();
    const looked = await Promise.all(
      files.map(async (file) => ({
        file,
        role: null,
        inspected: await inspect(file, file.name),
      })),
    );
    const names = new Set(files.map((file) => file.name));
    this.chosen = [...this.chosen.filter(({ file }) => !names.has(file.name)), ...looked];
    const roles = guessRoles(
      this.chosen.map(({ file, inspected }) => ({ name: file.name, inspected })),
    );
    for (const [i, role] of roles.entries()) this.chosen[i].role = role;
    say(
      this.chosen
        .map((c) => `${c.file.name}: ${c.role ? ROLE_NAMES[c.role] : "not sent"}`)
        .join("; "),
    );
    this.update();
  }

  private update(): void {
    replace(
      this.list,
      this.chosen.map((chosen) => this.row(chosen)),
    );
    this.list.hidden = !this.chosen.length;
    const hint = this.obstacle();
    this.send.disabled = hint !== null;
    this.hint.textContent = hint ?? this.summary();
    if (this.measured().length > 1) this.settings.open = true;
    this.showPreview();
  }

  private measured(): Chosen[] {
    return this.chosen.filter((c) => c.role === "measurements");
  }

  private obstacle(): string | null {
    if (!this.chosen.length) return "Choose a file with tracks first.";
    const number = (role: Role) => this.chosen.filter((c) => c.role === role).length;
    if (!number("measurements")) return "One of the files must be the measurements.";
    if (number("ground_truth") > 1 || number("faces") > 1) return "Two files have the same role.";
    if (number("measurements") > 1 && number("ground_truth")) {
      return "With ground truth, send one file of measurements at a time.";
    }
    const rest = sizeOf(this.chosen.filter((c) => c.role && c.role !== "measurements"));
    if (this.measured().some((c) => rest + c.file.size > this.most)) {
      return `That is more than the service takes at once (${bytes(this.most)}).`;
    }
    return null;
  }

  private summary(): string {
    const sent = this.chosen.filter((c) => c.role);
    const jobs = this.measured().length;
    const files = `${sent.length === 1 ? "1 file" : `${sent.length} files`}, ${bytes(sizeOf(sent))}`;
    return jobs > 1 ? `${files}: ${jobs} jobs` : files;
  }

  private row(chosen: Chosen): HTMLElement {
    const { file, inspected, role } = chosen;
    const { shape } = inspected;
    const first = this.measured()[0]?.inspected.shape;
    const tracks = first ? extentOf(first) : null;
    let { note } = inspected;
    if (!note && shape && role) note = misfit(role, shape, tracks);
    else if (!note && shape && ROLES.every((other) => misfit(other, shape, tracks))) {
      note = "Its shape is that of no tracks, ground truth or faces.";
    }
    const select = h("select", { "aria-label": `What ${file.name} is` });
    for (const value of ROLES) {
      append(select, h("option", { value, selected: value === role }, ROLE_NAMES[value]));
    }
    append(select, h("option", { value: "", selected: role === null }, "Do not send"));
    select.addEventListener("change", () => {
      chosen.role = (select.value || null) as Role | null;
      this.update();
      // The row was made anew; the focus stays where it was.
      this.list.querySelectorAll("select")[this.chosen.indexOf(chosen)]?.focus();
    });
    const drop = h(
      "button",
      { type: "button", class: "quiet", "aria-label": `Remove ${file.name}` },
      icon("close"),
    );
    drop.addEventListener("click", () => {
      this.chosen = this.chosen.filter((other) => other !== chosen);
      this.update();
      this.input.focus();
    });
    return h(
      "li",
      {},
      h(
        "div",
        { class: "file-name" },
        h("strong", {}, file.name),
        h("span", { class: "help" }, described(chosen)),
      ),
      select,
      drop,
      note ? h("p", { class: "note" }, note) : null,
    );
  }

  private buildPreview(): void {
    const button = h("button", { type: "button", class: "quiet" });
    const slider = h("input", { type: "range", min: "0", max: "0", "aria-label": "Frame" });
    const text = h("output", { class: "frame-label" });
    button.addEventListener("click", () => this.player.toggle());
    slider.addEventListener("input", () => this.player.seek(Number(slider.value)));
    this.player.onchange = () => {
      const { frame, frames, playing } = this.player;
      slider.max = String(frames - 1);
      slider.value = String(frame);
      text.textContent = `${frame + 1} / ${frames}`;
      this.trackView.seek(frame, playing);
      const name = playing ? "Pause" : "Play";
      if (button.getAttribute("aria-label") !== name) {
        button.setAttribute("aria-label", name);
        replace(button, icon(playing ? "pause" : "play"));
      }
    };
    append(
      this.preview,
      h("figure", { class: "stage stage-2d" }, this.canvas, this.caption),
      h("div", { class: "transport" }, button, h("div", { class: "timeline" }, slider), text),
      this.previewNote,
    );
  }

  private showPreview(): void {
    const measured: Chosen | undefined = this.measured()[0];
    const array = measured?.inspected.array;
    const layout = this.form?.values().layout as Layout | undefined;
    const tracks = array ? tracksOf(array, layout) : null;
    this.preview.hidden = tracks === null;
    this.trackView.show(tracks, tracks !== null && growsUp(tracks));
    if (!tracks) {
      this.player.pause();
      return;
    }
    const parts = this.measured().length > 1 ? [measured.file.name] : [];
    if (tracks.points < tracks.total) {
      parts.push(`${count(tracks.points)} of ${count(tracks.total)} points`);
    }
    this.caption.textContent = parts.join(" · ");
    this.warn();
    this.player.frames = tracks.frames;
    this.player.time = Math.min(this.player.time, tracks.frames - 1);
    this.player.onchange();
    if (!reducedMotion()) this.player.play();
  }

  /** Say what will make the job fail, as far as it is to be seen here. */
  private warn(): void {
    const most = Math.max(0, ...this.measured().map((c) => c.inspected.unseen ?? 0));
    const refused = (this.form?.values().missing ?? "refuse") === "refuse";
    const part = most < 0.001 ? "Less than 0.1" : significant(100 * most, 2);
    this.previewNote.textContent =
      most && refused
        ? `${part} % of the positions are not seen (NaN): the option Missing must be "complete".`
        : "";
  }

  private async start(): Promise<void> {
    if (this.send.disabled || !this.sending.hidden) return;
    const stop = new AbortController();
    const bar = h("progress", { max: 1, value: 0, "aria-label": "Upload" });
    const text = h("span", {}, "0 %");
    const cancel = h("button", { type: "button", onclick: () => stop.abort() }, "Stop");
    replace(this.sending, bar, text, cancel);
    this.sending.hidden = false;
    this.hint.hidden = true;
    this.send.disabled = true;
    this.problems.replaceChildren();
    say("Sending");
    const files: Partial<Record<Role, File>> = {};
    for (const { file, role } of this.chosen) if (role) files[role] = file;
    const settings: Record<string, string> = { priority: this.priority.value };
    if (this.batch.value) settings.batch = this.batch.value;
    const measured = this.measured();
    try {
      let last: Job | null = null;
      for (const [i, chosen] of measured.entries()) {
        last = await submit({
          files: { ...files, measurements: chosen.file },
          options: this.form?.values() ?? {},
          settings,
          progress: (fraction) => {
            bar.value = (i + fraction) / measured.length;
            text.textContent = fraction < 1 ? `${Math.round(100 * bar.value)} %` : "Being checked…";
          },
          signal: stop.signal,
        });
        // What is sent is not sent again where a later file is refused.
        if (measured.length > 1) this.chosen = this.chosen.filter((other) => other !== chosen);
      }
      if (this.signal.aborted) return say("Sent"); // who left meanwhile is not fetched back
      if (measured.length === 1) location.hash = `#/jobs/${last!.id}`;
      else location.hash = settings.batch ? `#/batches/${settings.batch}` : "#/jobs";
    } catch (error) {
      this.update();
      if ((error as Error).name === "AbortError") say("The upload was stopped");
      else {
        replace(this.problems, errorPanel(error));
        this.problems.scrollIntoView({ block: "nearest" });
      }
    } finally {
      this.sending.hidden = true;
      this.hint.hidden = false;
      this.send.disabled = this.obstacle() !== null;
    }
  }
}

const sizeOf = (files: Chosen[]): number => files.reduce((sum, c) => sum + c.file.size, 0);

function described({ file, inspected, role }: Chosen): string {
  const parts = [bytes(file.size)];
  const { shape } = inspected;
  const extent = shape && role === "measurements" ? extentOf(shape) : null;
  if (extent) parts.push(`${count(extent[0])} frames of ${count(extent[1])} points`);
  else if (shape && role === "faces") parts.push(`${count(shape[0])} triangles`);
  else if (shape) parts.push(`shape ${shape.join(" × ")}`);
  if (inspected.dtype && inspected.dtype !== "text") parts.push(typeName(inspected.dtype));
  return parts.join(" · ");
}

function typeName(dtype: string): string {
  const kind = { f: "float", i: "int", u: "uint", b: "bool" }[dtype.slice(-2, -1)];
  return kind ? `${kind}${8 * Number(dtype.slice(-1))}` : dtype;
}
