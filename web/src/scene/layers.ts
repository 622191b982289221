// What a map is drawn with: geometries of its keyframes, things, links.
import {
  BufferAttribute,
  BufferGeometry,
  Color,
  GridHelper,
  Group,
  InstancedMesh,
  LineBasicMaterial,
  LineSegments,
  Matrix4,
  MeshBasicMaterial,
  Points,
  PointsMaterial,
  Quaternion,
  SphereGeometry,
  SRGBColorSpace,
  Vector3 as V3,
} from "three";
import { type KeyframeItem, type LandmarkItem, type MapScene, type PointCloud, dot, hueColour, plus, scaled, uprightAxes } from "../model";
import { eigen } from "../statistics";
import type { Vector3 } from "../types";

type Rgb = readonly [number, number, number];

/** Colours are given as screens show them; three.js wants them linear. */
function linear([r, g, b]: Rgb): Rgb {
  const made = new Color().setRGB(r, g, b, SRGBColorSpace);
  return [made.r, made.g, made.b];
}

export function lines(positions: Float32Array, colours: Float32Array | null, colour: string | number, opacity = 1): LineSegments {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(positions, 3));
  if (colours) geometry.setAttribute("color", new BufferAttribute(colours, 3));
  const material = new LineBasicMaterial({ color: colours ? 0xffffff : colour, vertexColors: colours !== null, transparent: opacity < 1, opacity });
  const made = new LineSegments(geometry, material);
  made.frustumCulled = false;
  return made;
}

/** The pyramid of what a camera sees, up to `depth` metres: its top, then the corners. */
export function frustum(item: Pick<KeyframeItem, "position" | "axes" | "camera">, depth: number): Vector3[] {
  const { width, height, fx, fy, cx, cy } = item.camera;
  const [right, down, forward] = item.axes;
  const corner = (u: number, v: number): Vector3 =>
    plus(item.position, plus(scaled(right, ((u - cx) / fx) * depth), plus(scaled(down, ((v - cy) / fy) * depth), scaled(forward, depth))));
  return [item.position, corner(0, 0), corner(width, 0), corner(width, height), corner(0, height)];
}

const FRUSTUM_EDGES = [0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1];

export function frustumLines(items: readonly Pick<KeyframeItem, "position" | "axes" | "camera">[], depth: number, colours: readonly Rgb[], opacity = 1): LineSegments {
  const positions = new Float32Array(items.length * FRUSTUM_EDGES.length * 3);
  const paints = new Float32Array(positions.length);
  let at = 0;
  items.forEach((item, index) => {
    const corners = frustum(item, depth);
    const paint = linear(colours[index % colours.length] ?? [1, 1, 1]);
    for (const edge of FRUSTUM_EDGES) {
      positions.set(corners[edge] ?? item.position, at);
      paints.set(paint, at);
      at += 3;
    }
  });
  return lines(positions, paints, 0xffffff, opacity);
}

export function corners(item: Pick<LandmarkItem, "position" | "size" | "axes">): Vector3[] {
  const found: Vector3[] = [];
  for (const z of [-0.5, 0.5])
    for (const [x, y] of [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]] as const) {
      const side = plus(scaled(item.axes[0], x * item.size[0]), scaled(item.axes[1], y * item.size[1]));
      found.push(plus(item.position, plus(side, scaled(item.axes[2], z * item.size[2]))));
    }
  return found;
}

const BOX_EDGES = [0, 1, 1, 2, 2, 3, 3, 0, 4, 5, 5, 6, 6, 7, 7, 4, 0, 4, 1, 5, 2, 6, 3, 7];

export function boxLines(items: readonly LandmarkItem[], colourOf: (item: LandmarkItem) => Rgb, opacity = 1): LineSegments {
  const positions = new Float32Array(items.length * BOX_EDGES.length * 3);
  const paints = new Float32Array(positions.length);
  let at = 0;
  for (const item of items) {
    const eight = corners(item);
    const paint = linear(colourOf(item));
    for (const edge of BOX_EDGES) {
      positions.set(eight[edge] ?? item.position, at);
      paints.set(paint, at);
      at += 3;
    }
  }
  return lines(positions, paints, 0xffffff, opacity);
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
export function trails(scene: MapScene, dark: boolean): LineSegments {
  const ordered = [...scene.keyframes].sort((a, b) => a.recordingIndex - b.recordingIndex || a.frameIndex - b.frameIndex);
  const positions: number[] = [];
  const paints: number[] = [];
  for (let i = 1; i < ordered.length; i++) {
    const [from, to] = [ordered[i - 1], ordered[i]];
    if (!from || !to || from.recordingIndex !== to.recordingIndex) continue;
    const paint = linear(hueColour(to.recordingIndex, dark));
    positions.push(...from.position, ...to.position);
    paints.push(...paint, ...paint);
  }
  return lines(new Float32Array(positions), new Float32Array(paints), 0xffffff, 0.55);
}

export function linkLines(scene: MapScene, colour: string): LineSegments {
  const positions = new Float32Array(scene.links.length * 6);
  scene.links.forEach((link, i) => {
    positions.set(link.from.position, 6 * i);
    positions.set(link.to.position, 6 * i + 3);
  });
  return lines(positions, null, colour, 0.8);
}

/** Ellipsoids within which a thing's place is in 95 of 100 cases. */
export function ellipsoids(items: readonly LandmarkItem[], colour: string): InstancedMesh {
  const mesh = new InstancedMesh(
    new SphereGeometry(1, 12, 8),
    new MeshBasicMaterial({ color: colour, transparent: true, opacity: 0.35, depthWrite: false }),
    items.length,
  );
  const matrix = new Matrix4();
  items.forEach((item, index) => {
    const { values, vectors } = eigen(item.covariance);
    const [a, b, c] = values.map((value) => 2.8 * Math.sqrt(Math.max(value, 1e-8))) as [number, number, number];
    const [u, v, w] = vectors;
    matrix.makeBasis(new V3(...scaled(u, a)), new V3(...scaled(v, b)), new V3(...scaled(w, c)));
    matrix.setPosition(...item.position);
    mesh.setMatrixAt(index, matrix);
  });
  mesh.frustumCulled = false;
  return mesh;
}

/** A grid of squares of a metre at the height of the floor. */
export function floorGrid(scene: MapScene, centre: Vector3, radius: number, floor: number, colour: string): Group {
  const side = Math.max(2, 2 * Math.ceil(radius));
  const grid = new GridHelper(side, Math.min(side, 200), colour, colour);
  for (const material of [grid.material].flat()) {
    material.transparent = true;
    material.opacity = 0.35;
    material.depthWrite = false;
  }
  const group = new Group();
  const [first, second, up] = uprightAxes(scene.up);
  const base = plus(plus(scaled(first, Math.round(dot(centre, first))), scaled(second, Math.round(dot(centre, second)))), scaled(up, floor));
  group.quaternion.copy(new Quaternion().setFromUnitVectors(new V3(0, 1, 0), new V3(...up)));
  group.position.set(...base);
  group.add(grid);
  return group;
}
