/** Figures of a run, which the service draws when they are asked for. */

import { ask, save } from "../api";
import { h, replace } from "../dom";
import { errorPanel } from "../problem";

const FIGURES: Record<string, string> = {
  shapes: "The surface in four frames",
  cameras: "The path of the camera",
  convergence: "Convergence of the iterative stages",
  "singular-values": "Singular values of the tracks, and those the basis spans",
  error: "Error of each frame",
};

/**
 * A card that draws its figures when it is opened.
 *
 * @param link - gives their address, with `{name}` and `{form}` in it
 */
export function figuresCard(
  link: () => string,
  stem: string,
  withError: boolean,
  signal: AbortSignal,
): HTMLElement {
  const place = h("div", { class: "figures" });
  const details = h("details", {}, h("summary", {}, "Figures"), place);
  details.addEventListener(
    "toggle",
    () => {
      const names = Object.keys(FIGURES).filter((name) => name !== "error" || withError);
      replace(
        place,
        names.map((name) =>
          figure(link().replace("{name}", name), name, `${stem}-${name}`, signal),
        ),
      );
    },
    { once: true },
  );
  return h("section", { class: "card" }, details);
}

function figure(link: string, name: string, stem: string, signal: AbortSignal): HTMLElement {
  const place = h("div", { class: "figure-place" });
  const problems = h("div", { class: "problems" });
  const fail = (error: unknown) => {
    if (!signal.aborted) replace(problems, errorPanel(error));
  };
  const button = (form: string) =>
    h(
      "button",
      {
        type: "button",
        class: "link",
        "aria-label": `${FIGURES[name]}, ${form.toUpperCase()}`,
        onclick: () => void save(link.replace("{form}", form), `${stem}.${form}`).catch(fail),
      },
      form.toUpperCase(),
    );
  void drawn(link.replace("{form}", "png"), FIGURES[name], signal).then(
    (canvas) => replace(place, canvas),
    fail,
  );
  const caption = h("figcaption", {}, FIGURES[name], " ", button("png"), " ", button("svg"));
  return h("figure", {}, place, problems, caption);
}

/** Fetch a picture, with the key where there is one, and paint it: the policy knows no blob:. */
async function drawn(path: string, label: string, signal: AbortSignal): Promise<HTMLElement> {
  const picture = await createImageBitmap(await (await ask(path, { signal })).blob());
  const { width, height } = picture;
  const canvas = h("canvas", { role: "img", "aria-label": label, width, height });
  canvas.getContext("bitmaprenderer")!.transferFromImageBitmap(picture);
  return canvas;
}
