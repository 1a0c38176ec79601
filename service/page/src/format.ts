/** Numbers and moments as people read them. */

export function bytes(count: number): string {
  const units = ["B", "kB", "MB", "GB", "TB"];
  let unit = 0;
  let value = count;
  while (value >= 999.5 && unit < units.length - 1) {
    value /= 1000;
    unit += 1;
  }
  return `${unit && value < 10 ? value.toFixed(1) : Math.round(value)} ${units[unit]}`;
}

const grouped = new Intl.NumberFormat("en");
export const count = (value: number): string => grouped.format(value);

export function seconds(value: number): string {
  if (value < 10) return `${value.toFixed(value < 1 ? 2 : 1)} s`;
  if (value < 90) return `${Math.round(value)} s`;
  if (value < 5400) return `${Math.floor(value / 60)} min ${Math.round(value % 60)} s`;
  return `${Math.floor(value / 3600)} h ${Math.round((value % 3600) / 60)} min`;
}

/** Four significant digits, without an exponent where people would not write one. */
export function significant(value: number, digits = 3): string {
  if (value === 0 || !Number.isFinite(value)) return String(value);
  const size = Math.abs(value);
  if (size >= 1e5 || size < 1e-4) return value.toExponential(digits - 1);
  return String(Number(value.toPrecision(digits)));
}

/** An error with three digits, trailing zeros too, so that a column of them lines up. */
export const precise = (value: number): string =>
  Math.abs(value) >= 1e4 || Math.abs(value) < 1e-4 ? significant(value) : value.toPrecision(3);

const relative = new Intl.RelativeTimeFormat("en", { numeric: "auto" });

export function ago(moment: string): string {
  const past = (Date.parse(moment) - Date.now()) / 1000;
  const size = Math.abs(past);
  if (size < 45) return "just now";
  if (size < 3600) return relative.format(Math.round(past / 60), "minute");
  if (size < 86400) return relative.format(Math.round(past / 3600), "hour");
  return relative.format(Math.round(past / 86400), "day");
}

export const exact = (moment: string): string =>
  new Date(moment).toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "medium" });

export const sentence = (text: string): string => text.charAt(0).toUpperCase() + text.slice(1);

/** `camera_model` as a label. */
export const label = (name: string): string => sentence(name.replaceAll("_", " "));
