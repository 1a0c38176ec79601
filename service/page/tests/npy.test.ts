import { describe, expect, it } from "vitest";
import { parseHeader, readNpy, Unreadable, writeNpy } from "../src/data/npy";

/** An NPY file with a header as NumPy writes it. */
function file(dtype: string, fortran: boolean, shape: number[], body: Uint8Array): Uint8Array {
  const order = fortran ? "True" : "False";
  const dims = shape.length === 1 ? `${shape[0]},` : shape.join(", ");
  const text = `{'descr': '${dtype}', 'fortran_order': ${order}, 'shape': (${dims}), }\n`;
  const head = new TextEncoder().encode(text);
  const magic = [0x93, 0x4e, 0x55, 0x4d, 0x50, 0x59, 1, 0, head.length, 0];
  return Uint8Array.from([...magic, ...head, ...body]);
}

const bytesOf = (array: ArrayBufferView): Uint8Array =>
  new Uint8Array(array.buffer, array.byteOffset, array.byteLength);

describe("NPY files", () => {
  it("are read as they were written", () => {
    const data = Float32Array.of(1, 2.5, -3, Number.NaN, 5, 6);
    const read = readNpy(writeNpy(data, [2, 3]));
    expect(read.shape).toEqual([2, 3]);
    expect([...read.data]).toEqual([...data]);
  });

  it("have data that begin at a multiple of 64 bytes when written here", () => {
    for (const shape of [[4], [2, 2], [1, 1, 4], [100_000_000, 0]]) {
      const size = shape.reduce((a, b) => a * b, 1);
      expect(parseHeader(writeNpy(new Float32Array(size), shape)).offset % 64).toBe(0);
    }
  });

  it("may have their first index run fastest", () => {
    const columns = Float64Array.of(0, 10, 20, 1, 11, 21); // [[0, 1], [10, 11], [20, 21]]
    const read = readNpy(file("<f8", true, [3, 2], bytesOf(columns)));
    expect([...read.data]).toEqual([0, 1, 10, 11, 20, 21]);
  });

  it("may have their bytes the other way round", () => {
    const read = readNpy(file(">i2", false, [2], Uint8Array.of(1, 2, 255, 254)));
    expect([...read.data]).toEqual([258, -2]);
  });

  it("may hold integers of eight bytes", () => {
    const read = readNpy(file("<i8", false, [2], bytesOf(BigInt64Array.of(-1n, 1n << 40n))));
    expect([...read.data]).toEqual([-1, 2 ** 40]);
  });

  it.each([
    ["objects", file("|O", false, [1], new Uint8Array(8))],
    ["an array cut off", file("<f8", false, [3], new Uint8Array(16))],
    ["other bytes", new TextEncoder().encode("no numbers at all")],
  ])("with %s are refused", (_, bytes) => {
    expect(() => readNpy(bytes)).toThrow(Unreadable);
  });
});
