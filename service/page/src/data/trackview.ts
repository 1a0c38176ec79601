/** A canvas that draws the tracks of one frame, with the way that they came. */

import type { Tracks } from "./tracks";

/** Frames of the tail behind a point. */
const TAIL = 6;
const MOST_TAILS = 600;
const MOST_WHILE_PLAYING = 2000;

export class TrackView {
  private frame = 0;
  private upward = false;
  private tracks: Tracks | null = null;
  private readonly context: CanvasRenderingContext2D;
  private readonly watcher: ResizeObserver;

  constructor(readonly canvas: HTMLCanvasElement) {
    this.context = canvas.getContext("2d")!;
    this.watcher = new ResizeObserver(() => {
      const scale = Math.min(devicePixelRatio, 2);
      canvas.width = Math.max(1, Math.round(canvas.clientWidth * scale));
      canvas.height = Math.max(1, Math.round(canvas.clientHeight * scale));
      this.draw();
    });
    this.watcher.observe(canvas);
  }

  /** @param upward - whether the second coordinate grows upwards, other than that of pixels */
  show(tracks: Tracks | null, upward: boolean): void {
    this.tracks = tracks;
    this.upward = upward;
    this.draw();
  }

  seek(frame: number, playing = false): void {
    this.frame = frame;
    this.draw(playing);
  }

  dispose(): void {
    this.watcher.disconnect();
  }

  private draw(playing = false): void {
    const { context, canvas, tracks } = this;
    context.clearRect(0, 0, canvas.width, canvas.height);
    if (!tracks) return;
    const { bounds, points, positions } = tracks;
    const wide = bounds.right - bounds.left || 1;
    const high = bounds.bottom - bounds.top || 1;
    const margin = 0.06 * Math.min(canvas.width, canvas.height);
    const scale = Math.min((canvas.width - 2 * margin) / wide, (canvas.height - 2 * margin) / high);
    const x0 = (canvas.width - wide * scale) / 2 - bounds.left * scale;
    const turn = this.upward ? -scale : scale;
    const first = this.upward ? bounds.bottom : bounds.top;
    const y0 = (canvas.height - high * scale) / 2 - first * turn;
    const style = getComputedStyle(canvas);
    const frame = Math.min(Math.max(Math.round(this.frame), 0), tracks.frames - 1);

    const tails = Math.max(1, Math.ceil(points / MOST_TAILS));
    context.strokeStyle = style.getPropertyValue("--tail");
    context.lineWidth = Math.max(1, canvas.width / 600);
    context.beginPath();
    for (let i = 0; i < points; i += tails) {
      let pen = false;
      for (let t = Math.max(0, frame - TAIL); t <= frame; t += 1) {
        const at = 2 * (t * points + i);
        const u = positions[at];
        if (Number.isNaN(u)) {
          pen = false;
          continue;
        }
        const x = x0 + u * scale;
        const y = y0 + positions[at + 1] * turn;
        if (pen) context.lineTo(x, y);
        else context.moveTo(x, y);
        pen = true;
      }
    }
    context.stroke();

    context.fillStyle = style.getPropertyValue("--dot");
    const step = playing ? Math.max(1, Math.ceil(points / MOST_WHILE_PLAYING)) : 1;
    const area = (canvas.width * canvas.height) / Math.max(points / step, 1);
    const size = Math.min(Math.max(0.09 * Math.sqrt(area), 1.5), 0.012 * canvas.height + 2);
    for (let i = 0; i < points; i += step) {
      const at = 2 * (frame * points + i);
      const u = positions[at];
      if (!Number.isNaN(u)) {
        context.fillRect(
          x0 + u * scale - size / 2,
          y0 + positions[at + 1] * turn - size / 2,
          size,
          size,
        );
      }
    }
  }
}
