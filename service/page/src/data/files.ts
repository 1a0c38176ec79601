/** What the page can see of a file before it is sent. */

import { bytes as size } from "../format";
import { HEADER_BYTES, isNpy, type NumberArray, parseHeader, readNpy, Unreadable } from "./npy";
import { readTable } from "./text";

/** Larger files are sent without a look inside: a page must not take a gigabyte of memory. */
export const LARGEST_NPY = 512e6;
export const LARGEST_TEXT = 64e6;

/** A file that was looked at. */
export interface Inspected {
  shape: number[] | null;
  dtype: string | null;
  array: NumberArray | null;
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
      return { shape, dtype, array: readNpy(await contentOf(file)), note: null };
    }
    if (/\.(csv|txt)(\.gz)?$/i.test(name)) {
      if (file.size > LARGEST_TEXT) {
        return { ...nothing, note: `Tables above ${size(LARGEST_TEXT)} are not shown before.` };
      }
      const array = readTable(await textOf(file, name));
      return { shape: array.shape, dtype: "text", array, note: null };
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
    return { ...nothing, note: "This page does not know the format; the service will judge it." };
  } catch (error) {
    const reason = error instanceof Unreadable ? error.message : "The file cannot be read here.";
    return { ...nothing, note: reason };
  }
}

const contentOf = async (file: Blob): Promise<Uint8Array> =>
  new Uint8Array(await file.arrayBuffer());

async function textOf(file: Blob, name: string): Promise<string> {
  if (!/\.gz$/i.test(name)) return file.text();
  const plain = file.stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(plain).text();
}
