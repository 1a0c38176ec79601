/** The page: which view an address shows, and the key where the service asks for one. */

import { ask, connection, info, key, onKeyWanted } from "./api";
import { h, icon, replace } from "./dom";
import { batchView } from "./views/batch";
import { jobView } from "./views/job";
import { jobsView } from "./views/jobs";
import { submitView } from "./views/submit";

const main = document.getElementById("main")!;
let leaving = new AbortController();

function route(moved: boolean): void {
  leaving.abort();
  leaving = new AbortController();
  const { signal } = leaving;
  const path = location.hash.replace(/^#/, "") || "/";
  const job = /^\/jobs\/([0-9a-f]{32})$/.exec(path)?.[1];
  const batch = /^\/batches\/([\w.-]+)$/.exec(path)?.[1];
  document.title = "SMSR";
  let page = "jobs";
  if (job) replace(main, jobView(job, signal));
  else if (batch) replace(main, batchView(batch, signal));
  else if (path === "/jobs") replace(main, jobsView(signal));
  else if (path === "/") {
    page = "new";
    replace(
      main,
      h("div", { class: "home" }, submitView(signal), jobsView(signal, { short: true })),
    );
  } else {
    page = "";
    replace(main, h("p", {}, "There is nothing here. ", h("a", { href: "#/" }, "To the start")));
  }
  for (const link of document.querySelectorAll<HTMLElement>("nav [data-page]")) {
    if (link.dataset.page === page) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  if (moved) {
    scrollTo(0, 0);
    main.focus({ preventScroll: true });
  }
}

/** Ask for the key; it is kept for as long as the tab is open. */
function askForKey(): void {
  const place = document.getElementById("key")!;
  if (place.childElementCount) return;
  const wrong = key.get() !== null;
  const input = h("input", {
    type: "password",
    id: "key-input",
    autocomplete: "off",
    required: true,
    spellcheck: false,
  });
  const form = h(
    "form",
    { class: "key-form", "aria-label": "API key" },
    icon("key"),
    h(
      "label",
      { for: "key-input" },
      wrong ? "The service does not take this key. Another one:" : "This service wants an API key:",
    ),
    input,
    h("button", { type: "submit", class: "primary" }, "Use it"),
    h("p", { class: "help" }, "It is kept until this tab is closed."),
  );
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    key.set(input.value.trim());
    place.replaceChildren();
    showVersion();
    route(false);
  });
  place.replaceChildren(form);
  input.focus();
}

/** Say that the service does not answer, and look whether it does again. */
function showConnection(): void {
  const place = document.getElementById("away")!;
  place.hidden = !connection.lost;
  if (!connection.lost) return;
  replace(place, "The service does not answer. This page goes on as soon as it does.");
  const again = () => void ask("v1/info").catch(() => setTimeout(again, 3000));
  setTimeout(again, 3000);
}

function showVersion(): void {
  void info().then(
    ({ version }) => {
      document.getElementById("version")!.textContent = `SMSR ${version}`;
    },
    () => {},
  );
}

onKeyWanted.add(askForKey);
connection.onchange.add(showConnection);
addEventListener("hashchange", () => route(true));
document.querySelector(".skip")!.addEventListener("click", (event) => {
  event.preventDefault(); // its address would be a route
  main.focus();
});
route(false);
showVersion();
