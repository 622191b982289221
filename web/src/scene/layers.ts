// What a map is drawn with: geometries of its keyframes, things, links. All is opaque: see painter.ts.
import { BufferAttribute, BufferGeometry, Color, GridHelper, Group, LineBasicMaterial, LineSegments, Points, PointsMaterial, Quaternion, SRGBColorSpace, Vector3 as V3 } from "three";
import { type KeyframeItem, type LandmarkItem, type MapScene, type PointCloud, dot, hueColour, plus, scaled, uprightAxes } from "../model";
import type { Vector3 } from "../types";
import { rings } from "./overlay";
import { corners, frustum } from "./shapes";

export type Rgb = readonly [number, number, number];

/** Colours are given as screens show them; three.js wants them linear. */
function linear([r, g, b]: Rgb): Rgb {
  const made = new Color().setRGB(r, g, b, SRGBColorSpace);
  return [made.r, made.g, made.b];
}

/** As if `over` were drawn with so much of it over `under`. */
export function blended(over: Color, under: Color, share: number): Color {
  return under.clone().lerp(over, share);
}

function lines(positions: Float32Array, colours: Float32Array | null, colour: Color | null): LineSegments {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(positions, 3));
  if (colours) geometry.setAttribute("color", new BufferAttribute(colours, 3));
  const made = new LineSegments(geometry, new LineBasicMaterial({ color: colour ?? 0xffffff, vertexColors: colours !== null }));
  made.frustumCulled = false;
  return made;
}

/** Segments of many items, all of as many: `ends` gives the corners of one, `edges` which of them a line joins. */
function segments<T>(items: readonly T[], ends: (item: T) => readonly Vector3[], edges: readonly number[], paintOf: (item: T) => Rgb): LineSegments {
  const positions = new Float32Array(items.length * edges.length * 3);
  const paints = new Float32Array(positions.length);
  let at = 0;
  for (const item of items) {
    const places = ends(item);
    const paint = linear(paintOf(item));
    for (const edge of edges) {
      positions.set(places[edge] ?? [0, 0, 0], at);
      paints.set(paint, at);
      at += 3;
    }
  }
  return lines(positions, paints, null);
}

const FRUSTUM_EDGES = [0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1];
const BOX_EDGES = [0, 1, 1, 2, 2, 3, 3, 0, 4, 5, 5, 6, 6, 7, 7, 4, 0, 4, 1, 5, 2, 6, 3, 7];
const RING = 16;
const RING_EDGES = [0, 1, 2].flatMap((ring) => Array.from({ length: RING }, (_, k) => [ring * (RING + 1) + k, ring * (RING + 1) + k + 1]).flat());

/** Vertices of an item. */
export const VERTICES = { frustum: FRUSTUM_EDGES.length, box: BOX_EDGES.length, rings: RING_EDGES.length };

export function frustumLines(items: readonly KeyframeItem[], depth: number, paintOf: (item: KeyframeItem) => Rgb): LineSegments {
  return segments(items, (item) => frustum(item, depth), FRUSTUM_EDGES, paintOf);
}

export function boxLines(items: readonly LandmarkItem[], paintOf: (item: LandmarkItem) => Rgb): LineSegments {
  return segments(items, corners, BOX_EDGES, paintOf);
}

/** Ellipsoids within which a thing's place is in 95 of 100 cases, as three ellipses. */
export function ringLines(items: readonly LandmarkItem[], colour: string): LineSegments {
  const { r, g, b } = new Color(colour).convertLinearToSRGB();
  return segments(items, (item) => rings(item.position, item.covariance, RING).flat(), RING_EDGES, () => [r, g, b]);
}

export function cloudPoints(cloud: PointCloud, size: number): Points {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(cloud.positions, 3));
  const paints = new Uint8Array(cloud.colours);
  for (let i = 0; i < paints.length; i++) paints[i] = TO_LINEAR[paints[i] ?? 0] ?? 0;
  geometry.setAttribute("color", new BufferAttribute(paints, 3, true));
  const made = new Points(geometry, new PointsMaterial({ size, sizeAttenuation: true, vertexColors: true }));
  made.frustumCulled = false;
  return made;
}

/** Dots of so many pixels. */
export function dots(places: readonly Vector3[], colours: readonly Rgb[], size: number): Points {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(places.flat()), 3));
  geometry.setAttribute("color", new BufferAttribute(new Float32Array(colours.flatMap((paint) => linear(paint))), 3));
  const made = new Points(geometry, new PointsMaterial({ size, sizeAttenuation: false, vertexColors: true }));
  made.frustumCulled = false;
  return made;
}

const TO_LINEAR = Uint8Array.from({ length: 256 }, (_, i) => Math.round(255 * new Color().setRGB(i / 255, 0, 0, SRGBColorSpace).r));

/** Where each recording went: keyframes in the order of their frames. */
export function trails(scene: MapScene, dark: boolean, under: Color): LineSegments {
  const ordered = [...scene.keyframes].sort((a, b) => a.recordingIndex - b.recordingIndex || a.frameIndex - b.frameIndex);
  const positions: number[] = [];
  const paints: number[] = [];
  for (let i = 1; i < ordered.length; i++) {
    const [from, to] = [ordered[i - 1], ordered[i]];
    if (!from || !to || from.recordingIndex !== to.recordingIndex) continue;
    const { r, g, b } = blended(new Color().setRGB(...hueColour(to.recordingIndex, dark), SRGBColorSpace), under, 0.55);
    positions.push(...from.position, ...to.position);
    paints.push(r, g, b, r, g, b);
  }
  return lines(new Float32Array(positions), new Float32Array(paints), null);
}

export function linkLines(scene: MapScene, colour: string, under: Color): LineSegments {
  const positions = new Float32Array(scene.links.length * 6);
  scene.links.forEach((link, i) => {
    positions.set(link.from.position, 6 * i);
    positions.set(link.to.position, 6 * i + 3);
  });
  return lines(positions, null, blended(new Color(colour), under, 0.8));
}

/** A grid of squares of a metre at the height of the floor. */
export function floorGrid(scene: MapScene, centre: Vector3, radius: number, floor: number, colour: string, under: Color): Group {
  const side = Math.max(2, 2 * Math.ceil(radius));
  const paint = blended(new Color(colour), under, 0.35);
  const grid = new GridHelper(side, Math.min(side, 200), paint, paint);
  const group = new Group();
  const [first, second, up] = uprightAxes(scene.up);
  const base = plus(plus(scaled(first, Math.round(dot(centre, first))), scaled(second, Math.round(dot(centre, second)))), scaled(up, floor));
  group.quaternion.copy(new Quaternion().setFromUnitVectors(new V3(0, 1, 0), new V3(...up)));
  group.position.set(...base);
  group.add(grid);
  return group;
}
