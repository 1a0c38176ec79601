/** Errors as the user sees them. */

import { address, type Problem, Refused, remedyOf } from "./api";
import { append, h } from "./dom";

/** A panel with what is wrong, what would be right, and where that is documented. */
export function problemPanel(problem: Problem): HTMLElement {
  const panel = h(
    "div",
    { class: "problem", role: "alert" },
    h("h3", {}, problem.title),
    problem.detail ? h("p", {}, marked(problem.detail)) : null,
  );
  const slug = /^\/problems\/([a-z0-9-]+)$/.exec(problem.type)?.[1];
  if (slug) {
    const remedy = h("p", { class: "remedy" });
    append(
      panel,
      remedy,
      h(
        "p",
        { class: "more" },
        h("a", { href: address(`problems/${slug}`) }, "About this problem"),
      ),
    );
    void remedyOf(problem).then((text) => {
      if (text) append(remedy, h("strong", {}, "What helps: "), marked(text));
    });
  }
  return panel;
}

/** Names between backticks, as code. */
const marked = (text: string): (string | HTMLElement)[] =>
  text.split("`").map((part, i) => (i % 2 ? h("code", {}, part) : part));

/** The panel of anything that was thrown. */
export function errorPanel(error: unknown): HTMLElement {
  // The form that asks for the key says the rest.
  if (error instanceof Refused && error.problem.status === 401) {
    return h("p", { class: "empty" }, "To be seen with an API key.");
  }
  if (error instanceof Refused) return problemPanel(error.problem);
  const detail = error instanceof Error ? error.message : String(error);
  return problemPanel({ type: "about:blank", title: "That did not work", status: 0, detail });
}
