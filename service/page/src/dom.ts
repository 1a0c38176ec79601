/** Building elements without a framework, and without the inline styles that the CSP forbids. */

type Child = Node | string | number | null | undefined | false;
type Properties = Record<string, unknown>;

/**
 * Make an element.
 *
 * Members of `properties` are set as properties where the element has one of the name, listeners
 * where they begin with "on", and attributes otherwise; null and false leave an attribute out.
 */
export function h<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  properties: Properties = {},
  ...children: (Child | Child[])[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith("on")) {
      element.addEventListener(name.slice(2), value as EventListener);
    } else if (name === "class") {
      element.className = String(value);
    } else if (name in element && name !== "list" && !name.startsWith("aria")) {
      (element as unknown as Properties)[name] = value;
    } else if (value !== null && value !== undefined && value !== false) {
      element.setAttribute(name, value === true ? "" : String(value));
    }
  }
  append(element, ...children);
  return element;
}

export function append(parent: Node, ...children: (Child | Child[])[]): void {
  for (const child of children.flat()) {
    if (child !== null && child !== undefined && child !== false) {
      parent.appendChild(child instanceof Node ? child : document.createTextNode(String(child)));
    }
  }
}

export function replace(parent: Element, ...children: (Child | Child[])[]): void {
  parent.replaceChildren();
  append(parent, ...children);
}

const SVG = "http://www.w3.org/2000/svg";

export function svg(tag: string, attributes: Record<string, string | number>, ...children: Node[]) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, String(value));
  element.append(...children);
  return element;
}

const ICONS: Record<string, string> = {
  play: "M7 4.5v15l12-7.5z",
  pause: "M6 5h4v14H6zM14 5h4v14h-4z",
  back: "M18 5v14l-9-7zM6 5h2v14H6z",
  forward: "M6 5v14l9-7zM16 5h2v14h-2z",
  down: "M12 3v11m-5-5 5 5 5-5M4 20h16",
  upload: "M12 16V4m-5 5 5-5 5 5M4 20h16",
  close: "M6 6l12 12M18 6 6 18",
  retry: "M20 11a8 8 0 1 0-2.3 6.3M20 4v7h-7",
  bin: "M4 7h16M9 7V4h6v3m3 0-1 13H7L6 7",
  view: "M12 2.5v5m0 9v5M2.5 12h5m9 0h5M12 7.5a4.5 4.5 0 1 0 .01 0z",
  key: "M14 10a4.5 4.5 0 1 0-1.5 3.3L15 16h3v3h3v-3.5l-7-5.5",
};
const SOLID = new Set(["play", "pause", "back", "forward"]);

/** A drawing of 24 by 24 units; what it means stands in the text or label beside it. */
export function icon(name: string): SVGElement {
  const solid = SOLID.has(name);
  const path = svg("path", {
    d: ICONS[name],
    fill: solid ? "currentColor" : "none",
    stroke: solid ? "none" : "currentColor",
    "stroke-width": 2,
    "stroke-linecap": "round",
    "stroke-linejoin": "round",
  });
  return svg(
    "svg",
    { viewBox: "0 0 24 24", width: 18, height: 18, class: "icon", "aria-hidden": "true" },
    path,
  ) as SVGElement;
}

/** Tell users of screen readers something that is only to be seen otherwise. */
export function say(text: string): void {
  const area = document.getElementById("said");
  if (area && area.textContent !== text) area.textContent = text;
}

/** Whether the user asked the system for less movement. */
export const reducedMotion = (): boolean => matchMedia("(prefers-reduced-motion: reduce)").matches;
