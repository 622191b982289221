// A map from above, in SVG: light, and there without WebGL. What stands out is drawn over it.
import { type KeyframeItem, type LandmarkItem, type MapScene, dot, uprightAxes } from "../model";
import { texts } from "../texts";
import type { Vector3 } from "../types";
import { fill, svg } from "./h";

const WIDTH = 800;
const HEIGHT = 560;
const MARGIN = 36;
const MOST_BOXES = 400;

/** A camera that is drawn over the map. `forward` is where it looks. */
export interface Shown {
  position: Vector3;
  forward?: Vector3;
  kind: "good" | "warn" | "bad" | "accent" | "old";
  label?: string;
  /** Standard deviation of the position, metres. */
  sigma?: number;
}

export interface Arrow {
  from: Vector3;
  to: Vector3;
}

export interface Mark {
  position: Vector3;
  kind: "good" | "warn" | "bad" | "accent";
  label: string;
}

export class TopMap {
  readonly element: SVGSVGElement;
  private readonly over: SVGElement;
  private readonly first: Vector3;
  private readonly second: Vector3;
  private scale = 1;
  private left = 0;
  private low = 0;
  private height = 0;
  private view = { x: 0, y: 0, w: WIDTH, h: HEIGHT };

  constructor(
    readonly scene: MapScene,
    more: readonly Vector3[] = [],
  ) {
    const [first, second] = uprightAxes(scene.up);
    [this.first, this.second] = [first, second];
    this.measure(more);
    this.over = svg("g", { class: "over" });
    this.element = svg("svg", { class: "topmap", viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": texts.topmap.label(scene.name) }) as SVGSVGElement;
    this.element.append(...this.ground(), this.over);
    this.listen();
  }

  /** Replaces what is drawn over the map. */
  show(cameras: readonly Shown[], arrows: readonly Arrow[] = [], marks: readonly Mark[] = [], keyframes: ReadonlySet<number> = new Set(), landmarks: ReadonlySet<number> = new Set(), paths: readonly (readonly Vector3[])[] = []): void {
    const drawn: SVGElement[] = paths.map((path) => svg("polyline", { class: "trail", points: path.map((point) => this.at(point).map((value) => value.toFixed(1)).join(",")).join(" ") }));
    for (const item of this.scene.landmarks) if (landmarks.has(item.id)) drawn.push(this.box(item, "chosen", true));
    for (const item of this.scene.keyframes) if (keyframes.has(item.id)) drawn.push(this.camera({ position: item.position, forward: item.axes[2], kind: "accent" }));
    for (const arrow of arrows) drawn.push(this.arrow(arrow));
    for (const mark of marks) drawn.push(...this.mark(mark));
    for (const camera of cameras) drawn.push(this.camera(camera));
    fill(this.over, ...drawn);
  }

  private measure(more: readonly Vector3[]): void {
    const points = [...this.scene.keyframes.map((item) => item.position), ...this.scene.landmarks.slice(0, 5000).map((item) => item.position), ...more];
    const xs = points.map((point) => dot(point, this.first));
    const ys = points.map((point) => dot(point, this.second));
    const bounds = (values: number[]): [number, number] =>
      values.length === 0 ? [-1, 1] : [values.reduce((a, b) => Math.min(a, b)), values.reduce((a, b) => Math.max(a, b))];
    const [[x0, x1], [y0, y1]] = [bounds(xs), bounds(ys)];
    this.scale = Math.min((WIDTH - 2 * MARGIN) / Math.max(x1 - x0, 1), (HEIGHT - 2 * MARGIN) / Math.max(y1 - y0, 1));
    this.left = WIDTH / 2 - (this.scale * (x0 + x1)) / 2;
    this.low = HEIGHT / 2 + (this.scale * (y0 + y1)) / 2;
    this.height = HEIGHT;
  }

  private at(point: Vector3): [number, number] {
    return [this.left + this.scale * dot(point, this.first), this.low - this.scale * dot(point, this.second)];
  }

  private ground(): SVGElement[] {
    const drawn: SVGElement[] = [this.ruler()];
    const things = this.scene.landmarks.filter((item) => item.state !== "gone");
    if (things.length <= MOST_BOXES) drawn.push(...things.map((item) => this.box(item, "thing", things.length <= 60)));
    else drawn.push(svg("path", { class: "thing dots", d: things.map((item) => this.dot(item.position)).join("") }));
    drawn.push(svg("path", { class: "keyframes dots", d: this.scene.keyframes.map((item: KeyframeItem) => this.dot(item.position)).join("") }));
    return drawn;
  }

  private ruler(): SVGElement {
    const metres = [1, 2, 5, 10, 20, 50, 100, 200, 500].find((step) => step * this.scale > 60) ?? 1000;
    const y = this.height - 14;
    return svg(
      "g",
      { class: "ruler" },
      svg("path", { d: `M14 ${y - 5}v5h${metres * this.scale}v-5` }),
      svg("text", { x: 18, y: y - 6 }, `${metres} m`),
    );
  }

  private dot(point: Vector3): string {
    const [x, y] = this.at(point);
    return `M${x.toFixed(1)} ${y.toFixed(1)}h0`;
  }

  private box(item: LandmarkItem, kind: string, named: boolean): SVGElement {
    const [ax, ay] = [item.axes[0], item.axes[1]].map((axis, k) => {
      const half = Math.max((item.size[k as 0] ?? 0) / 2, 0.02);
      return [this.scale * half * dot(axis, this.first), -this.scale * half * dot(axis, this.second)] as const;
    }) as [readonly [number, number], readonly [number, number]];
    const [x, y] = this.at(item.position);
    const corner = (i: number, j: number): string => `${(x + i * ax[0] + j * ay[0]).toFixed(1)},${(y + i * ax[1] + j * ay[1]).toFixed(1)}`;
    const shape = svg("polygon", { class: kind, points: [corner(1, 1), corner(1, -1), corner(-1, -1), corner(-1, 1)].join(" ") });
    const group = svg("g", {}, svg("title", {}, `${item.category} ${item.id}`), shape);
    const across = Math.hypot(ax[0], ax[1]) + Math.hypot(ay[0], ay[1]);
    if (named && (across > 14 || kind === "chosen")) group.append(svg("text", { class: `name ${kind}`, x, y: y + 3 }, item.category));
    return group;
  }

  private camera(shown: Shown): SVGElement {
    const [x, y] = this.at(shown.position);
    const group = svg("g", { class: `camera ${shown.kind}` });
    if (shown.forward) {
      const angle = Math.atan2(-dot(shown.forward, this.second), dot(shown.forward, this.first));
      const ray = (turn: number, length: number): string => `${(x + length * Math.cos(angle + turn)).toFixed(1)} ${(y + length * Math.sin(angle + turn)).toFixed(1)}`;
      group.append(svg("path", { class: "sight", d: `M${x} ${y}L${ray(-0.5, 46)}L${ray(0.5, 46)}Z` }));
    }
    if (shown.sigma !== undefined) {
      const radius = 2.45 * shown.sigma * this.scale; // of a plane 95 % lie within
      group.append(svg("circle", { class: "sigma", cx: x, cy: y, r: Math.max(radius, 0.1) }));
    }
    group.append(svg("circle", { class: "body", cx: x, cy: y, r: 6 }));
    if (shown.label) group.append(svg("text", { x, y: y - 11 }, shown.label));
    return group;
  }

  private arrow({ from, to }: Arrow): SVGElement {
    const [[x1, y1], [x2, y2]] = [this.at(from), this.at(to)];
    const angle = Math.atan2(y2 - y1, x2 - x1);
    const barb = (turn: number): string => `${(x2 - 10 * Math.cos(angle + turn)).toFixed(1)} ${(y2 - 10 * Math.sin(angle + turn)).toFixed(1)}`;
    return svg("path", { class: "arrow", d: `M${x1} ${y1}L${x2} ${y2}M${barb(0.5)}L${x2} ${y2}L${barb(-0.5)}` });
  }

  private mark({ position, kind, label }: Mark): SVGElement[] {
    const [x, y] = this.at(position);
    return [svg("circle", { class: `mark ${kind}`, cx: x, cy: y, r: 9 }), svg("text", { class: `name mark-name ${kind}`, x, y: y - 13 }, label)];
  }

  /** The wheel comes nearer, dragging moves. */
  private listen(): void {
    let grabbed: { x: number; y: number } | null = null;
    const apply = (): void => this.element.setAttribute("viewBox", `${this.view.x} ${this.view.y} ${this.view.w} ${this.view.h}`);
    const size = (): number => this.view.w / Math.max(this.element.clientWidth, 1);
    this.element.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !this.element.matches(":focus-within, :hover")) return;
      event.preventDefault();
      const factor = Math.exp(event.deltaY * 0.0015);
      const box = this.element.getBoundingClientRect();
      const [u, v] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
      const w = Math.min(WIDTH * 1.5, Math.max(WIDTH / 40, this.view.w * factor));
      const hh = (w * HEIGHT) / WIDTH;
      this.view = { x: this.view.x + u * (this.view.w - w), y: this.view.y + v * (this.view.h - hh), w, h: hh };
      apply();
    }, { passive: false });
    this.element.addEventListener("pointerdown", (event) => {
      grabbed = { x: event.clientX, y: event.clientY };
      this.element.setPointerCapture(event.pointerId);
    });
    this.element.addEventListener("pointermove", (event) => {
      if (!grabbed) return;
      this.view.x -= (event.clientX - grabbed.x) * size();
      this.view.y -= (event.clientY - grabbed.y) * size();
      grabbed = { x: event.clientX, y: event.clientY };
      apply();
    });
    this.element.addEventListener("pointerup", () => (grabbed = null));
    this.element.addEventListener("dblclick", () => {
      this.view = { x: 0, y: 0, w: WIDTH, h: HEIGHT };
      apply();
    });
  }
}
