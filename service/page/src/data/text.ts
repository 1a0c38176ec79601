/** Tables of numbers as text: fields apart by commas, semicolons, tabs or blanks, `#` comments. */

import { type NumberArray, Unreadable } from "./npy";

export function readTable(text: string): NumberArray {
  const values: number[] = [];
  let width = 0;
  let rows = 0;
  let named = false;
  for (const raw of text.replace(/^\ufeff/, "").split("\n")) {
    const line = raw.replace(/#.*/, "").trim();
    if (!line) continue;
    const fields = split(line);
    if (!rows && !named && fields.every((field) => /^["']?(?!nan|inf)[a-z_]/i.test(field))) {
      named = true;
      continue;
    }
    if (!rows) width = fields.length;
    rows += 1;
    if (fields.length !== width) {
      throw new Unreadable(
        `Row ${rows} of the table has ${fields.length} fields, the first has ${width}.`,
      );
    }
    for (const field of fields) values.push(number(field, rows));
  }
  if (!rows) throw new Unreadable("The file holds no table of numbers.");
  return { shape: [rows, width], dtype: "text", data: Float64Array.from(values) };
}

function split(line: string): string[] {
  const separator = [";", ",", "\t"].find((mark) => line.includes(mark));
  return separator ? line.split(separator).map((field) => field.trim()) : line.split(/\s+/);
}

function number(field: string, row: number): number {
  if (field === "" || /^[+-]?nan$/i.test(field)) return Number.NaN;
  if (/^[+-]?inf(inity)?$/i.test(field)) return field.startsWith("-") ? -Infinity : Infinity;
  const value = Number(field);
  if (Number.isNaN(value)) throw new Unreadable(`Row ${row} of the table holds "${field}".`);
  return value;
}
