/** Time: which frame is shown, and how it goes on by itself. */

/** Frames in a second at the speed 1. */
const FRAME_RATE = 25;

export class Player {
  /** Position in frames; between two of them while playing. */
  time = 0;
  playing = false;
  speed = 1;
  frames = 1;
  /** Called whenever the position or the state changes. */
  onchange: () => void = () => {};
  private last = 0;
  private request = 0;

  get frame(): number {
    return Math.min(Math.round(this.time), this.frames - 1);
  }

  play(): void {
    if (this.playing || this.frames < 2) return;
    this.playing = true;
    this.last = performance.now();
    this.request = requestAnimationFrame(this.tick);
    this.onchange();
  }

  pause(): void {
    cancelAnimationFrame(this.request);
    if (!this.playing) return;
    this.playing = false;
    this.time = this.frame; // a still picture shows a frame, not something between two
    this.onchange();
  }

  toggle(): void {
    if (this.playing) this.pause();
    else this.play();
  }

  seek(frame: number): void {
    this.pause();
    this.time = Math.min(Math.max(Math.round(frame), 0), this.frames - 1);
    this.onchange();
  }

  /** Go on or back by frames, round the ends. */
  step(by: number): void {
    this.seek((this.frame + by + this.frames * Math.ceil(Math.abs(by))) % this.frames);
  }

  private readonly tick = (now: number): void => {
    if (!this.playing) return;
    // The time of the first picture may lie before the call that asked for it.
    const passed = Math.min(Math.max((now - this.last) / 1000, 0), 0.25);
    this.last = now;
    this.time += passed * this.speed * FRAME_RATE;
    // The last frame is held for a frame's time, then the first follows without a blend.
    if (this.time >= this.frames) this.time %= this.frames;
    this.request = requestAnimationFrame(this.tick);
    this.onchange();
  };
}
