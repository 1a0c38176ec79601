/** What the page can see of a file before it is sent. */

import { bytes as size } from "../format";
import { HEADER_BYTES, isNpy, type NumberArray, parseHeader, readNpy, Unreadable } from "./npy";
import { readTable } from "./text";

/** Larger files are sent without a look inside: a page must not take a gigabyte of memory. */
const LARGEST_NPY = 512e6;
const LARGEST_TEXT = 64e6;

/** A file that was looked at. */
export interface Inspected {
  shape: number[] | null;
  dtype: string | null;
  array: NumberArray | null;
  /** Part of the numbers that are none (NaN). */
  unseen?: number;
  /** Why the numbers are not shown, where they are not. */
  note: string | null;
}

/** Look into a file. Never throws: what cannot be read here, the service may still take. */
export async function inspect(file: Blob, name: string): Promise<Inspected> {
  const nothing = { shape: null, dtype: null, array: null };
  try {
    const head = new Uint8Array(await file.slice(0, HEADER_BYTES).arrayBuffer());
    if (file.size === 0) return { ...nothing, note: "The file is empty." };
    if (isNpy(head)) {
      const { shape, dtype } = parseHeader(head);
      if (file.size > LARGEST_NPY) {
        return { shape, dtype, array: null, note: "Too large to be shown before it is sent." };
      }
      return seen(readNpy(await contentOf(file)));
    }
    if (/\.(csv|txt)(\.gz)?$/i.test(name)) {
      if (file.size > LARGEST_TEXT) {
        return { ...nothing, note: `Tables above ${size(LARGEST_TEXT)} are not shown before.` };
      }
      return seen(readTable(await textOf(file, name)));
    }
    const kind = /\.(npz|mat)$/i.exec(name)?.[1].toLowerCase();
    if (kind) {
      return {
        ...nothing,
        note:
          `The service reads .${kind} files, this page does not: there is no preview, ` +
          "and everything else works as ever.",
      };
    }
    const unlike = /\.npy$/i.test(name)
      ? "This is no NPY file, whatever its name says"
      : "This page does not know the format";
    return { ...nothing, note: `${unlike}; the service will judge it.` };
  } catch (error) {
    const reason = error instanceof Unreadable ? error.message : "The file cannot be read here.";
    return { ...nothing, note: reason };
  }
}

function seen(array: NumberArray): Inspected {
  let lacking = 0;
  for (const value of array.data) if (Number.isNaN(value)) lacking += 1;
  const { shape, dtype, data } = array;
  return { shape, dtype, array, unseen: lacking / Math.max(data.length, 1), note: null };
}

const contentOf = async (file: Blob): Promise<Uint8Array> =>
  new Uint8Array(await file.arrayBuffer());

async function textOf(file: Blob, name: string): Promise<string> {
  if (!/\.gz$/i.test(name)) return file.text();
  const plain = file.stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(plain).text();
}
