/** The form of a job's options, built from what the service says of them. */

import type { Option } from "./api";
import { h } from "./dom";
import { label } from "./format";

/** Options that stand in the open; the others wait behind "More options". */
const COMMON = ["preset", "layout", "missing", "outliers", "camera_model", "camera_scale"];

export interface OptionForm {
  element: HTMLElement;
  /** Values that differ from the defaults. */
  values: () => Record<string, unknown>;
  /** Called with the name of an option that changed. */
  onchange: (name: string) => void;
}

export function optionForm(options: Option[]): OptionForm {
  const fields = new Map<string, () => unknown>();
  const form: OptionForm = {
    element: h("div", { class: "options" }),
    values: () => {
      const values: Record<string, unknown> = {};
      for (const option of options) {
        const value = fields.get(option.name)!();
        if (value !== undefined && value !== option.default) values[option.name] = value;
      }
      return values;
    },
    onchange: () => {},
  };
  const make = (option: Option): HTMLElement => {
    const { element, value } = field(option, () => form.onchange(option.name));
    fields.set(option.name, value);
    return element;
  };
  const common = COMMON.flatMap((name) => options.filter((option) => option.name === name));
  const rest = options.filter((option) => !common.includes(option));
  form.element.append(
    h("div", { class: "option-grid" }, common.map(make)),
    h(
      "details",
      { class: "more-options" },
      h("summary", {}, `More options (${rest.length})`),
      h("div", { class: "option-grid" }, rest.map(make)),
    ),
  );
  return form;
}

function field(option: Option, changed: () => void) {
  const id = `option-${option.name}`;
  const help = h("p", { class: "help", id: `${id}-help` }, option.help);
  const described = { id, "aria-describedby": help.id, onchange: changed };
  let control: HTMLElement;
  let value: () => unknown;
  if (option.choices || option.type === "boolean") {
    const choices = option.choices ?? ["true", "false"];
    const select = h("select", described);
    if (option.nullable) select.append(h("option", { value: "" }, "automatic"));
    for (const choice of choices) {
      const text = option.type === "boolean" ? { true: "on", false: "off" }[choice]! : choice;
      select.append(h("option", { value: choice, selected: choice === `${option.default}` }, text));
    }
    control = select;
    value = () => {
      if (select.value === "") return null;
      return option.type === "boolean" ? select.value === "true" : select.value;
    };
  } else {
    const numeric = option.type !== "string";
    const input = h("input", {
      ...described,
      type: numeric ? "number" : "text",
      step: option.type === "integer" ? "1" : "any",
      min: option.minimum ?? "",
      max: option.maximum ?? "",
      placeholder: placeholder(option),
      autocomplete: "off",
    });
    control = input;
    value = () => {
      if (input.value.trim() === "") return undefined;
      return numeric ? Number(input.value) : input.value;
    };
  }
  return {
    element: h(
      "div",
      { class: "option" },
      h("label", { for: id }, label(option.name)),
      control,
      help,
    ),
    value,
  };
}

function placeholder({ default: value, type }: Option): string {
  if (value === null) return type === "string" ? "" : "automatic";
  return String(value);
}
