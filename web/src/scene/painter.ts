// When and how much is drawn. While the view moves, a beginning of everything; once it rests, the rest of it piece by
// piece over the same picture, so that no frame takes long. What is drawn so hides by depth and is opaque: then the
// order does not matter.
import { type BufferGeometry, type Camera, type Object3D, type Scene, type WebGLRenderer } from "three";

/** A geometry of many items, any beginning of which is spread over all of them. */
export interface Part {
  object: Object3D & { geometry: BufferGeometry };
  items: number;
  /** Vertices, or indices, of an item. */
  vertices: number;
  /** How much an item takes, a point being 1. */
  cost: number;
  /** At most so many while the view moves. */
  moving: number;
}

const REST_MS = 220;
/** A frame is to take so long; what is drawn in it follows what the last ones took. */
const AIM_MS = 45;
const PAUSE_MS = 30;
const ENOUGH = 0.7; // of what may be drawn
const LEAST = 12_000; // less saves little: a frame without any takes longer than these
const MOST = 4_000_000;
const ONCE = 0;
const AGAIN = 1; // three.js' layers: everything, and what is drawn piece by piece

export class Painter {
  /** Times between the frames of the last pictures, milliseconds. */
  readonly frames: number[] = [];
  private parts: Part[] = [];
  private done: number[] = [];
  private asked = 0;
  private resting = 0;
  private last: number | null = null;
  private idle = 0; // milliseconds from the last frame until another one was asked for
  private anew = true;
  private budget: number;
  private spent = 0; // of it in the last frame

  constructor(
    private readonly renderer: WebGLRenderer,
    private readonly world: Scene,
    private readonly camera: () => Camera,
    /** Before the first piece of a picture, and after it. */
    private readonly around: { before: (moving: boolean) => void; after: (moving: boolean) => void },
    software: boolean,
  ) {
    this.budget = software ? 15_000 : 500_000;
  }

  dispose(): void {
    cancelAnimationFrame(this.asked);
    clearTimeout(this.resting);
  }

  /** Everything of the picture is there. */
  get complete(): boolean {
    return !this.anew && !this.resting && this.parts.every((part, k) => !shown(part) || (this.done[k] ?? 0) >= part.items);
  }

  set(parts: readonly Part[]): void {
    this.parts = [...parts];
    for (const part of parts) part.object.layers.enable(AGAIN);
    this.invalidate();
  }

  /** The picture is to be drawn anew. */
  invalidate(): void {
    this.anew = true;
    this.ask();
  }

  /** Something moves: less is drawn until it rests. */
  stir(): void {
    clearTimeout(this.resting);
    this.resting = setTimeout(() => {
      this.resting = 0;
      this.invalidate();
    }, REST_MS) as unknown as number;
    this.invalidate();
  }

  private ask(): void {
    if (this.asked) return;
    this.idle = this.last === null ? 0 : performance.now() - this.last;
    this.asked = requestAnimationFrame((now) => {
      this.asked = 0;
      this.draw(now);
    });
  }

  private draw(now: number): void {
    this.learn(now);
    const first = this.anew;
    if (first) {
      this.anew = false;
      this.around.before(this.resting !== 0);
      this.done = this.parts.map(() => 0);
    }
    let left = this.budget;
    this.parts.forEach((part, k) => {
      const from = this.done[k] ?? 0;
      const most = first && this.resting ? Math.min(part.moving, part.items) : part.items;
      const share = Math.floor((k + 1 < this.parts.length ? left / 2 : left) / part.cost);
      const to = Math.min(most, from + (shown(part) ? share : 0));
      left -= (to - from) * part.cost;
      part.object.geometry.setDrawRange(from * part.vertices, (to - from) * part.vertices);
      this.done[k] = to;
    });
    this.spent = this.budget - left;
    const camera = this.camera();
    camera.layers.set(first ? ONCE : AGAIN);
    this.renderer.autoClear = first;
    this.renderer.render(this.world, camera);
    if (first) this.around.after(this.resting !== 0);
    const more = !this.resting && !this.complete;
    this.last = more || this.resting ? now : null;
    if (more) this.ask();
  }

  /** Draws more a frame where the last one was quick, less where it was slow. */
  private learn(now: number): void {
    if (this.last === null) return;
    const took = now - this.last;
    if (this.idle > PAUSE_MS || took > 2000) return; // nothing moved meanwhile, or the tab was hidden
    this.frames.push(took);
    if (this.frames.length > 200) this.frames.shift();
    const factor = Math.min(1.4, Math.max(0.4, AIM_MS / took));
    if (factor > 1 && this.spent < ENOUGH * this.budget) return; // a frame that drew little tells nothing of more
    this.budget = Math.min(MOST, Math.max(LEAST, this.budget * (factor < 1 ? factor : Math.sqrt(factor))));
  }
}

function shown({ object }: Part): boolean {
  return object.visible && (object.parent?.visible ?? true);
}
