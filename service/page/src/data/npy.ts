/** The NPY format (NumPy enhancement proposal 1): its header, and numbers out of its bytes. */

export type Numbers =
  | Float32Array
  | Float64Array
  | Int8Array
  | Int16Array
  | Int32Array
  | Uint8Array
  | Uint16Array
  | Uint32Array;

/** An array of numbers in C order. */
export interface NumberArray {
  shape: number[];
  dtype: string;
  data: Numbers;
}

export interface NpyHeader {
  /** As NumPy writes it, for instance "<f4". */
  dtype: string;
  fortran: boolean;
  shape: number[];
  /** Where the data begin. */
  offset: number;
  itemSize: number;
}

/** The file cannot be read here; the message says why, for the user. */
export class Unreadable extends Error {}

const MAGIC = [0x93, 0x4e, 0x55, 0x4d, 0x50, 0x59];
/** Bytes that hold the header of any array of numbers. */
export const HEADER_BYTES = 4096;

export function isNpy(head: Uint8Array): boolean {
  return MAGIC.every((byte, i) => head[i] === byte);
}

export function parseHeader(head: Uint8Array): NpyHeader {
  if (!isNpy(head)) throw new Unreadable("This is no NPY file.");
  const view = new DataView(head.buffer, head.byteOffset, head.byteLength);
  const long = head[6] >= 2;
  const start = long ? 12 : 10;
  if (head.length < start) throw new Unreadable("The NPY file ends within its header.");
  const length = long ? view.getUint32(8, true) : view.getUint16(8, true);
  if (start + length > head.length) throw new Unreadable("The NPY file ends within its header.");
  const text = new TextDecoder("latin1").decode(head.subarray(start, start + length));
  const dtype = /'descr':\s*'([^']*)'/.exec(text)?.[1];
  const fortran = /'fortran_order':\s*(True|False)/.exec(text)?.[1];
  const shape = /'shape':\s*\(([^)]*)\)/.exec(text)?.[1];
  if (dtype === undefined || fortran === undefined || shape === undefined) {
    throw new Unreadable("The NPY file holds no plain array of numbers.");
  }
  const kind = /^[<>|=]?([fiub])([1248])$/.exec(dtype);
  if (!kind)
    throw new Unreadable(`The NPY file holds entries of type ${dtype}, not plain numbers.`);
  return {
    dtype,
    fortran: fortran === "True",
    shape: shape
      .split(",")
      .filter((s) => s.trim())
      .map(Number),
    offset: start + length,
    itemSize: Number(kind[2]),
  };
}

export const sizeOf = (shape: number[]): number => shape.reduce((a, b) => a * b, 1);

/** Read a whole NPY file. Eight-byte integers become doubles. */
export function readNpy(bytes: Uint8Array): NumberArray {
  const header = parseHeader(bytes);
  const size = sizeOf(header.shape);
  if (bytes.length < header.offset + size * header.itemSize) {
    throw new Unreadable("The NPY file ends before its array does.");
  }
  const body = bytes.slice(header.offset, header.offset + size * header.itemSize);
  if (header.dtype.startsWith(">")) swapBytes(body, header.itemSize);
  const data = numbers(body.buffer, header.dtype.slice(-2));
  const ordered = header.fortran ? fromFortran(data, header.shape) : data;
  return { shape: header.shape, dtype: header.dtype, data: ordered };
}

function swapBytes(body: Uint8Array, itemSize: number): void {
  for (let i = 0; i < body.length; i += itemSize) body.subarray(i, i + itemSize).reverse();
}

function numbers(buffer: ArrayBuffer, kind: string): Numbers {
  switch (kind) {
    case "f4":
      return new Float32Array(buffer);
    case "f8":
      return new Float64Array(buffer);
    case "i1":
      return new Int8Array(buffer);
    case "i2":
      return new Int16Array(buffer);
    case "i4":
      return new Int32Array(buffer);
    case "u1":
    case "b1":
      return new Uint8Array(buffer);
    case "u2":
      return new Uint16Array(buffer);
    case "u4":
      return new Uint32Array(buffer);
    case "i8":
      return Float64Array.from(new BigInt64Array(buffer), Number);
    case "u8":
      return Float64Array.from(new BigUint64Array(buffer), Number);
    default:
      throw new Unreadable(`Entries of type ${kind} cannot be shown here.`);
  }
}

/** Reorder an array whose first index runs fastest into one whose last does. */
function fromFortran(data: Numbers, shape: number[]): Numbers {
  if (shape.length < 2) return data;
  const out = data.slice();
  const index = new Array<number>(shape.length).fill(0);
  for (let i = 0; i < data.length; i += 1) {
    let at = 0;
    for (let axis = 0; axis < shape.length; axis += 1) at = at * shape[axis] + index[axis];
    out[at] = data[i];
    for (let axis = 0; axis < shape.length; axis += 1) {
      index[axis] += 1;
      if (index[axis] < shape[axis]) break;
      index[axis] = 0;
    }
  }
  return out;
}

/** Write numbers as an NPY file. */
export function writeNpy(
  data: Float32Array | Int32Array,
  shape: number[],
): Uint8Array<ArrayBuffer> {
  const dtype = data instanceof Float32Array ? "<f4" : "<i4";
  const dims = shape.length === 1 ? `${shape[0]},` : shape.join(", ");
  let text = `{'descr': '${dtype}', 'fortran_order': False, 'shape': (${dims}), }`;
  text = `${text.padEnd(Math.ceil((text.length + 11) / 64) * 64 - 11)}\n`;
  const out = new Uint8Array(10 + text.length + data.byteLength);
  out.set([...MAGIC, 1, 0, text.length & 255, text.length >> 8]);
  out.set(new TextEncoder().encode(text), 10);
  out.set(new Uint8Array(data.buffer, data.byteOffset, data.byteLength), 10 + text.length);
  return out;
}
