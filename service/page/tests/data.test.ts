import { describe, expect, it } from "vitest";
import { guessRoles, misfit, type Role } from "../src/data/roles";
import { readTable } from "../src/data/text";
import { growsUp, tracksOf } from "../src/data/tracks";
import { EventParser } from "../src/events";
import { ticks, viridis } from "../src/viewer/colours";
import { plan, spread } from "../src/viewer/result";

const looked = (shape: number[] | null, dtype = "<f4") => ({
  shape,
  dtype,
  array: null,
  note: null,
});

describe("roles of files", () => {
  it.each([
    [
      ["W.npy", [120, 400], "<f8"],
      ["S.npy", [60, 400, 3], "<f8"],
      ["tri.npy", [700, 3], "<i4"],
    ],
    [
      ["a.npy", [60, 2, 400], "<f4"],
      ["b.npy", [60, 3, 400], "<f4"],
      ["c.npy", [700, 3], "<i8"],
    ],
    [
      ["tracks.mat", null, null],
      ["ground_truth.mat", null, null],
      ["faces.mat", null, null],
    ],
  ] as [string, number[] | null, string][][])("are seen from names and shapes: %j", (...files) => {
    const candidates = files.map(([name, shape, dtype]) => ({
      name,
      inspected: looked(shape, dtype),
    }));
    expect(guessRoles(candidates)).toEqual(["measurements", "ground_truth", "faces"]);
    expect(guessRoles([...candidates].reverse())).toEqual([
      "faces",
      "ground_truth",
      "measurements",
    ]);
  });

  it("are each given once, but for measurements", () => {
    const given = (shape: number[], dtype: string) =>
      guessRoles([1, 2].map((i) => ({ name: `x${i}.npy`, inspected: looked(shape, dtype) })));
    expect(given([20, 2, 9], "<f4")).toEqual(["measurements", "measurements"]);
    expect(given([21, 3], "<i4").filter((role) => role === "faces")).toHaveLength(1);
    expect(given([20, 3, 9], "<f4").filter((role) => role === "ground_truth")).toHaveLength(1);
  });

  it("tell a matrix of true shapes from that of its tracks", () => {
    const files = [180, 120].map((rows) => ({ name: "x.npy", inspected: looked([rows, 50]) }));
    expect(guessRoles(files)).toEqual(["ground_truth", "measurements"]);
  });

  it.each([
    ["measurements", [121, 50], /2T/],
    ["measurements", [4, 50], /At least 3 frames/],
    ["ground_truth", [60, 49, 3], /T = 60 and N = 50/],
    ["faces", [3, 100], /\(F, 3\)/],
    ["measurements", [60, 2, 50], null],
    ["ground_truth", [180, 50], null],
    ["ground_truth", [60, 3, 50], null],
    ["faces", [100, 3], null],
  ] as [Role, number[], RegExp | null][])("%s of shape %j", (role, shape, wrong) => {
    const found = misfit(role, shape, [60, 50]);
    if (wrong) expect(found).toMatch(wrong);
    else expect(found).toBeNull();
  });
});

describe("tables", () => {
  it("may have a line of names, comments, gaps and any separator", () => {
    const table = readTable("a;b;c\n# a comment\n1;;3\n-4; 5e2 ;nan\n");
    expect(table.shape).toEqual([2, 3]);
    expect([...table.data]).toEqual([1, Number.NaN, 3, -4, 500, Number.NaN]);
    expect([...readTable("1 2\n3\t4\n".replace("\t", " ")).data]).toEqual([1, 2, 3, 4]);
  });

  it("with rows of different lengths are refused", () => {
    expect(() => readTable("1,2\n3\n")).toThrow(/Row 2/);
  });
});

describe("tracks", () => {
  it("are the same in every layout", () => {
    const [frames, points] = [3, 4];
    const at = (t: number, i: number, axis: number) => 100 * t + 10 * i + axis;
    const make = (order: (t: number, i: number, axis: number) => number) => {
      const data = new Float64Array(frames * points * 2);
      for (let t = 0; t < frames; t += 1) {
        for (let i = 0; i < points; i += 1) {
          for (let axis = 0; axis < 2; axis += 1) data[order(t, i, axis)] = at(t, i, axis);
        }
      }
      return data;
    };
    const interleaved = make((t, i, axis) => (2 * t + axis) * points + i);
    const stacked = make((t, i, axis) => (axis * frames + t) * points + i);
    const last = make((t, i, axis) => (t * points + i) * 2 + axis);
    const of = (shape: number[], data: Float64Array, layout?: "stacked") =>
      tracksOf({ shape, dtype: "<f8", data }, layout)!.positions;
    const expected = Float32Array.from(last);
    expect(of([6, 4], interleaved)).toEqual(expected);
    expect(of([6, 4], stacked, "stacked")).toEqual(expected);
    expect(of([3, 2, 4], interleaved)).toEqual(expected);
    expect(of([3, 4, 2], last)).toEqual(expected);
    expect(tracksOf({ shape: [5, 4], dtype: "<f8", data: last })).toBeNull();
  });

  it("are pixels where the first frame has no negative coordinates", () => {
    const up = (...data: number[]) =>
      growsUp(tracksOf({ shape: [4, 2], dtype: "<f8", data: Float64Array.from(data) })!);
    expect(up(0, 5, 3, Number.NaN, -1, -1, -1, -1)).toBe(false);
    expect(up(0, 5, 3, -0.1, 1, 1, 1, 1)).toBe(true);
  });
});

describe("events", () => {
  it("are put together from any pieces of the stream", () => {
    const text = 'event: job\r\ndata: {"a":\r\ndata: 1}\r\nid: 7\r\n\r\n: a comment\n\ndata: x\n\n';
    for (let size = 1; size < text.length; size += 1) {
      const parser = new EventParser();
      const found = [];
      for (let i = 0; i < text.length; i += size)
        found.push(...parser.push(text.slice(i, i + size)));
      expect(found).toEqual([
        { name: "job", data: '{"a":\n1}', id: "7" },
        { name: "message", data: "x", id: "7" },
      ]);
    }
  });
});

describe("large results", () => {
  it("show points spread evenly, however few", () => {
    for (const count of [1, 2, 10, 99, 1000]) {
      expect([...spread(count)].sort((a, b) => a - b)).toEqual([...Array(count).keys()]);
    }
    const first = [...spread(100_000).subarray(0, 1000)].sort((a, b) => a - b);
    const gaps = first.slice(1).map((x, i) => x - first[i]);
    expect(Math.max(...gaps)).toBeLessThan(300); // three times the mean
  });

  it("keep to what is held and fetched", () => {
    const limits = { held: 12e6, fetched: 60e6 };
    const small = plan(10, 1000, limits);
    expect([small.stride, small.pointNumbers.length]).toEqual([1, 1000]);
    const large = plan(100, 500_000, limits);
    const frames = large.frameNumbers.length;
    expect(12 * frames * 500_000).toBeLessThanOrEqual(1.2 * limits.fetched);
    expect(12 * frames * large.pointNumbers.length).toBeLessThanOrEqual(limits.held);
    expect(large.pointNumbers.length).toBeGreaterThan(0);
  });
});

describe("colours", () => {
  it("grow lighter all the way", () => {
    const light = Array.from({ length: 64 }, (_, i) => {
      const [r, g, b] = viridis(i / 63);
      return 0.2126 * r + 0.7152 * g + 0.0722 * b;
    });
    for (let i = 1; i < light.length; i += 1) expect(light[i]).toBeGreaterThan(light[i - 1]);
  });

  it("have round numbers in the legend", () => {
    expect(ticks(0, 1)).toEqual([0, 0.2, 0.4, 0.6, 0.8, 1]);
    expect(ticks(-137, 92)).toEqual([-100, -50, 0, 50]);
    expect(ticks(3, 3)).toEqual([3]);
  });
});
