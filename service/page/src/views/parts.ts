/** What several views show of a job. */

import { isActive, type Job, post, remove, type Status } from "../api";
import { h, icon } from "../dom";

export const STATUS_NAMES: Record<Status, string> = {
  queued: "Queued",
  running: "Running",
  succeeded: "Done",
  failed: "Failed",
  cancelled: "Cancelled",
};

export function badge(job: Job): HTMLElement {
  const stopping = job.cancel_requested && isActive(job);
  const percent =
    job.status === "running" && job.progress && !stopping
      ? ` ${Math.round(100 * job.progress.fraction)} %`
      : "";
  return h(
    "span",
    { class: `badge ${job.status}` },
    stopping ? "Stopping" : STATUS_NAMES[job.status] + percent,
  );
}

/**
 * All that a job shows but for its progress, which only its badge tells. Where nothing else changed,
 * buttons have to stay: a press is lost on one that is replaced meanwhile.
 */
export const apartFromProgress = (job: Job): string => JSON.stringify({ ...job, progress: null });

export const title = (job: Job): string => job.name ?? `Job ${job.id.slice(0, 8)}`;

/** Names and values; what has no value is left out. */
export function facts(entries: [string, string | null | undefined][]): HTMLElement {
  return h(
    "dl",
    { class: "facts-list" },
    entries
      .filter(([, value]) => value !== null && value !== undefined)
      .map(([name, value]) => h("div", {}, h("dt", {}, name), h("dd", {}, value))),
  );
}

/** The label of a job's batch, which leads to it. */
export const batchLink = (label: string): HTMLElement =>
  h("a", { class: "batch-link", href: `#/batches/${label}` }, label);

/** Buttons for what can be done with a job; `failed` gets what went wrong, `gone` a deletion. */
export function actions(
  job: Job,
  on: { changed: (job: Job) => void; gone: () => void; failed: (error: unknown) => void },
  words = true,
): HTMLElement[] {
  const buttons: HTMLElement[] = [];
  const button = (name: string, glyph: string, act: () => Promise<void>) => {
    const element = h(
      "button",
      {
        type: "button",
        class: words ? "" : "quiet",
        "aria-label": `${name} ${title(job)}`,
        title: name,
      },
      icon(glyph),
      words ? name : null,
    );
    element.addEventListener("click", async () => {
      element.disabled = true;
      try {
        await act();
      } catch (error) {
        on.failed(error);
      } finally {
        element.disabled = false;
      }
    });
    buttons.push(element);
  };
  if (job.links.cancel && !job.cancel_requested) {
    button("Cancel", "close", async () => on.changed(await post<Job>(job.links.cancel!)));
  }
  if (job.links.retry) {
    button("Run again", "retry", async () => on.changed(await post<Job>(job.links.retry!)));
  }
  button("Delete", "bin", async () => {
    if (!(await confirmed(`Delete ${title(job)} and its files?`))) return;
    await remove(job.links.self!);
    on.gone();
  });
  return buttons;
}

/** Ask before what cannot be undone. */
export function confirmed(question: string): Promise<boolean> {
  return new Promise((resolve) => {
    const keep = h("button", { value: "keep" }, "Keep it");
    const dialog = h(
      "dialog",
      { "aria-labelledby": "question" },
      h(
        "form",
        { method: "dialog" },
        h("h2", { id: "question" }, question),
        h("p", {}, "This cannot be undone."),
        h(
          "div",
          { class: "row" },
          keep,
          h("button", { value: "delete", class: "danger" }, icon("bin"), "Delete"),
        ),
      ),
    );
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(dialog.returnValue === "delete");
    });
    document.body.append(dialog);
    dialog.showModal();
    keep.focus();
  });
}
