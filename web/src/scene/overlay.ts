// What stands out, over the picture: what is selected, photos, cameras that move. It changes without the picture's
// being drawn anew, lines may be thick, and it is there for maps of any size.
import { type Camera, Matrix4, Vector4 } from "three";
import { type KeyframeItem, type LandmarkItem, plus, scaled } from "../model";
import { eigen } from "../statistics";
import type { Vector3 } from "../types";
import { colour } from "../ui/theme";
import { corners, frustum } from "./shapes";

/** A camera that is none of the map's: a photo, or one that moves. */
export interface Extra {
  item: Pick<KeyframeItem, "position" | "axes" | "camera">;
  /** A colour of the style sheet. */
  paint: string;
  label?: string;
  /** xx, xy, xz, yy, yz, zz of its place, square metres. */
  covariance?: readonly number[];
  /** Where it was. */
  path?: readonly Vector3[];
  /** Places of keyframes that it was found by. */
  by?: readonly Vector3[];
  faint?: boolean;
}

interface Stroke {
  places: readonly Vector3[];
  paint: string;
  width: number;
  alpha: number;
  filled?: number;
  dashes?: readonly number[];
}

interface Name {
  at: Vector3;
  text: string;
  paint: string;
}

const FRUSTUM_FACES = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [1, 2, 3, 4, 1]] as const;
const BOX_PATHS = [[0, 1, 2, 3, 0], [4, 5, 6, 7, 4], [0, 4], [1, 5], [2, 6], [3, 7]] as const;
const ROUND = 40;
const SIGMAS_95 = 2.8; // of three dimensions, 95 % are within

export class Overlay {
  readonly element = document.createElement("canvas");
  private chosen: Stroke[] = [];
  private extras: Stroke[] = [];
  private names: Name[] = [];

  constructor(private readonly ratio: number) {
    this.element.className = "over";
    this.element.setAttribute("aria-hidden", "true");
  }

  /** Marks keyframes and things; what they were before is forgotten. */
  choose(keyframes: readonly KeyframeItem[], landmarks: readonly LandmarkItem[], size: number): void {
    const paint = "--scene-select";
    const pick = (places: readonly Vector3[], order: readonly number[]): Vector3[] => order.map((k) => places[k] ?? [0, 0, 0]);
    const frusta = keyframes.flatMap((item) => FRUSTUM_FACES.map((face): Stroke => ({ places: pick(frustum(item, 1.3 * size), face), paint, width: 2, alpha: 1 })));
    const boxes = landmarks.flatMap((item) => BOX_PATHS.map((path): Stroke => ({ places: pick(corners(item), path), paint, width: 2, alpha: 1 })));
    this.chosen = [...frusta, ...boxes];
  }

  show(extras: readonly Extra[], size: number): void {
    this.names = extras.flatMap(({ item, label, paint }) => (label === undefined ? [] : [{ at: item.position, text: label, paint }]));
    this.extras = extras.flatMap((one) => strokesOf(one, size));
  }

  draw(camera: Camera, width: number, height: number): void {
    const { element, ratio } = this;
    element.hidden = this.chosen.length + this.extras.length === 0; // a layer over the picture takes time of its own
    if (element.hidden) return;
    const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (element.width !== w || element.height !== h) Object.assign(element, { width: w, height: h });
    const pen = element.getContext("2d");
    if (!pen) return;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    camera.updateMatrixWorld();
    const look = new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse.copy(camera.matrixWorld).invert());
    const paints = new Map<string, string>();
    const paintOf = (name: string): string => {
      const known = paints.get(name) ?? colour(name);
      paints.set(name, known);
      return known;
    };
    for (const stroke of [...this.extras, ...this.chosen]) {
      const line = projected(stroke.places, look, width, height);
      if (line.length < 2) continue;
      pen.beginPath();
      line.forEach(({ x, y, begins }) => (begins ? pen.moveTo(x, y) : pen.lineTo(x, y)));
      pen.setLineDash([...(stroke.dashes ?? [])]);
      if (stroke.filled !== undefined) {
        pen.globalAlpha = stroke.filled;
        pen.fillStyle = paintOf(stroke.paint);
        pen.fill();
      }
      pen.globalAlpha = stroke.alpha;
      pen.strokeStyle = paintOf(stroke.paint);
      pen.lineWidth = stroke.width;
      pen.stroke();
    }
    pen.globalAlpha = 1;
    pen.setLineDash([]);
    this.write(pen, look, width, height, paintOf);
  }

  private write(pen: CanvasRenderingContext2D, look: Matrix4, width: number, height: number, paintOf: (name: string) => string): void {
    pen.font = "600 13px system-ui, sans-serif";
    pen.textAlign = "center";
    pen.lineWidth = 4;
    pen.lineJoin = "round";
    for (const { at, text, paint } of this.names) {
      const spot = projected([at, at], look, width, height)[0];
      if (!spot) continue;
      pen.strokeStyle = paintOf("--scene");
      pen.strokeText(text, spot.x, spot.y - 12);
      pen.fillStyle = paintOf(paint);
      pen.fillText(text, spot.x, spot.y - 12);
    }
  }
}

function strokesOf({ item, paint, covariance, path, by, faint }: Extra, size: number): Stroke[] {
  const places = frustum(item, (faint ? 1 : 2) * size);
  const alpha = faint ? 0.45 : 1;
  const found: Stroke[] = FRUSTUM_FACES.map((face) => ({ places: face.map((k) => places[k] ?? item.position), paint, width: faint ? 1 : 2.5, alpha, ...(faint ? {} : { filled: 0.1 }) }));
  for (const place of by ?? []) found.push({ places: [item.position, place], paint, width: 1.5, alpha: 0.7, dashes: [5, 5] });
  if (path && path.length > 1) found.push({ places: path, paint, width: 2, alpha: 0.8 });
  if (covariance) for (const ring of rings(item.position, covariance)) found.push({ places: ring, paint, width: 1, alpha: 0.9, filled: 0.12 });
  return found;
}

/** The three great ellipses of where a place is in 95 of 100 cases. */
export function rings(at: Vector3, covariance: readonly number[], round = ROUND): Vector3[][] {
  const { values, vectors } = eigen(covariance);
  const axes = values.map((value, k) => scaled(vectors[k as 0], SIGMAS_95 * Math.sqrt(Math.max(value, 1e-8))));
  return [[0, 1], [0, 2], [1, 2]].map(([u, v]) =>
    Array.from({ length: round + 1 }, (_, i): Vector3 => {
      const turn = (2 * Math.PI * i) / round;
      return plus(at, plus(scaled(axes[u ?? 0] ?? [0, 0, 0], Math.cos(turn)), scaled(axes[v ?? 0] ?? [0, 0, 0], Math.sin(turn))));
    }),
  );
}

/** A line in pixels, as far as it is before the camera. */
function projected(places: readonly Vector3[], look: Matrix4, width: number, height: number): { x: number; y: number; begins: boolean }[] {
  const found: { x: number; y: number; begins: boolean }[] = [];
  const nearest = 1e-3;
  const seen = places.map((place) => new Vector4(...place, 1).applyMatrix4(look));
  const add = (spot: Vector4, begins: boolean): void => {
    found.push({ x: ((spot.x / spot.w + 1) / 2) * width, y: ((1 - spot.y / spot.w) / 2) * height, begins });
  };
  seen.forEach((spot, k) => {
    const before = seen[k - 1];
    const cut = (from: Vector4, to: Vector4): Vector4 => from.clone().lerp(to, (nearest - from.w) / (to.w - from.w));
    if (spot.w >= nearest) {
      if (before && before.w < nearest) add(cut(before, spot), true);
      add(spot, k === 0);
    } else if (before && before.w >= nearest) add(cut(before, spot), false);
  });
  return found;
}
