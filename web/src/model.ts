// A map as it is drawn: the columns of /v1/maps/{map}/scene with what is looked up in them. No three.js here.
import type { Vector3 } from "./types";

export interface SceneColumns {
  map: string;
  up: Vector3 | null;
  keyframes: {
    recordings: string[];
    cameras: { width: number; height: number; fx: number; fy: number; cx: number; cy: number }[];
    id: number[];
    recording: number[];
    camera: number[];
    frame_index: number[];
    timestamp_ns: (number | null)[];
    position: number[];
    quat_wxyz: number[];
  };
  landmarks: {
    categories: string[];
    states: string[];
    id: number[];
    category: number[];
    state: number[];
    probability: number[];
    position: number[];
    covariance: number[];
    size: number[];
    yaw: number[];
    keyframes: number[];
    last_seen_ns: (number | null)[];
  };
  links: { kinds: string[]; kind: number[]; keyframe: number[]; other_keyframe: number[]; inliers: number[] };
}

export interface KeyframeItem {
  index: number;
  id: number;
  recording: string;
  recordingIndex: number;
  frameIndex: number;
  timestampNs: number | null;
  position: Vector3;
  /** Columns: axes x right, y down, z forward of the camera in the map. */
  axes: [Vector3, Vector3, Vector3];
  camera: SceneColumns["keyframes"]["cameras"][number];
}

export interface LandmarkItem {
  index: number;
  id: number;
  category: string;
  categoryIndex: number;
  state: string;
  probability: number;
  position: Vector3;
  /** xx, xy, xz, yy, yz, zz, square metres. */
  covariance: readonly number[];
  size: Vector3;
  /** Axes of the box in the map, the third one is up. */
  axes: [Vector3, Vector3, Vector3];
  keyframes: number;
  lastSeenNs: number | null;
}

export interface MapScene {
  name: string;
  up: Vector3;
  upKnown: boolean;
  recordings: string[];
  categories: string[];
  keyframes: KeyframeItem[];
  landmarks: LandmarkItem[];
  links: { from: KeyframeItem; to: KeyframeItem; kind: string; inliers: number }[];
  keyframe: (id: number) => KeyframeItem | undefined;
  landmark: (id: number) => LandmarkItem | undefined;
}

export function axesOf(w: number, x: number, y: number, z: number): [Vector3, Vector3, Vector3] {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
  ];
}

export const dot = (a: Vector3, b: Vector3): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a: Vector3, b: Vector3): Vector3 => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];
export const scaled = (a: Vector3, s: number): Vector3 => [a[0] * s, a[1] * s, a[2] * s];
export const plus = (a: Vector3, b: Vector3): Vector3 => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const distance = (a: Vector3, b: Vector3): number => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
export function unit(a: Vector3): Vector3 {
  const length = Math.hypot(...a) || 1;
  return scaled(a, 1 / length);
}

/** Axes of a frame with `up` as third one, the first near to the map's x: that of the yaw of boxes. */
export function uprightAxes(up: Vector3): [Vector3, Vector3, Vector3] {
  const third = unit(up);
  let helper: Vector3 = [1, 0, 0];
  if (Math.abs(third[0]) > 0.9) {
    const least = [0, 1, 2].reduce((best, i) => (Math.abs(third[i as 0]) < Math.abs(third[best as 0]) ? i : best), 0);
    helper = [0, 0, 0];
    helper[least as 0] = 1;
  }
  const first = unit(plus(helper, scaled(third, -dot(helper, third))));
  return [first, cross(third, first), third];
}

function three(values: readonly number[], index: number): Vector3 {
  return [values[3 * index] ?? 0, values[3 * index + 1] ?? 0, values[3 * index + 2] ?? 0];
}

export function sceneOf(columns: SceneColumns): MapScene {
  const k = columns.keyframes;
  const keyframes = k.id.map((id, index): KeyframeItem => {
    const [w = 1, x = 0, y = 0, z = 0] = k.quat_wxyz.slice(4 * index, 4 * index + 4);
    const recordingIndex = k.recording[index] ?? 0;
    return {
      index,
      id,
      recording: k.recordings[recordingIndex] ?? "",
      recordingIndex,
      frameIndex: k.frame_index[index] ?? 0,
      timestampNs: k.timestamp_ns[index] ?? null,
      position: three(k.position, index),
      axes: axesOf(w, x, y, z),
      camera: k.cameras[k.camera[index] ?? 0] ?? { width: 640, height: 480, fx: 525, fy: 525, cx: 320, cy: 240 },
    };
  });
  const up = columns.up ?? guessedUp(keyframes);
  const [first, second, third] = uprightAxes(columns.up ?? [0, 0, 1]);
  const l = columns.landmarks;
  const landmarks = l.id.map((id, index): LandmarkItem => {
    const yaw = l.yaw[index] ?? 0;
    const c = Math.cos(yaw);
    const s = Math.sin(yaw);
    const categoryIndex = l.category[index] ?? 0;
    return {
      index,
      id,
      category: l.categories[categoryIndex] ?? "",
      categoryIndex,
      state: l.states[l.state[index] ?? 0] ?? "",
      probability: l.probability[index] ?? 0,
      position: three(l.position, index),
      covariance: l.covariance.slice(6 * index, 6 * index + 6),
      size: three(l.size, index),
      axes: [plus(scaled(first, c), scaled(second, s)), plus(scaled(first, -s), scaled(second, c)), third],
      keyframes: l.keyframes[index] ?? 0,
      lastSeenNs: l.last_seen_ns[index] ?? null,
    };
  });
  const byId = new Map(keyframes.map((item) => [item.id, item]));
  const landmarkById = new Map(landmarks.map((item) => [item.id, item]));
  const links = columns.links.keyframe.flatMap((id, index) => {
    const from = byId.get(id);
    const to = byId.get(columns.links.other_keyframe[index] ?? -1);
    const kind = columns.links.kinds[columns.links.kind[index] ?? 0] ?? "";
    return from && to ? [{ from, to, kind, inliers: columns.links.inliers[index] ?? 0 }] : [];
  });
  return {
    name: columns.map,
    up: unit(up),
    upKnown: columns.up !== null,
    recordings: k.recordings,
    categories: l.categories,
    keyframes,
    landmarks,
    links,
    keyframe: (id) => byId.get(id),
    landmark: (id) => landmarkById.get(id),
  };
}

/** People hold cameras upright, more or less: up is against the mean of the cameras' y axes. */
function guessedUp(keyframes: readonly KeyframeItem[]): Vector3 {
  const sum = keyframes.reduce<Vector3>((total, item) => plus(total, scaled(item.axes[1], -1)), [0, 0, 0]);
  return Math.hypot(...sum) > 0.3 * keyframes.length && keyframes.length > 0 ? unit(sum) : [0, 0, 1];
}

/** So many points of a map are asked for. */
export const MOST_POINTS = 100_000;

export interface PointCloud {
  count: number;
  keyframes: number;
  positions: Float32Array;
  colours: Uint8Array;
}

/** The points of /v1/maps/{map}/points. */
export function pointsOf(buffer: ArrayBuffer): PointCloud {
  const [count = 0, keyframes = 0] = new Uint32Array(buffer, 0, 2);
  const scale = new Float32Array(buffer, 8, 6);
  const grid = new Uint16Array(buffer, 32, 3 * count);
  const positions = new Float32Array(3 * count);
  for (let axis = 0; axis < 3; axis++) {
    const low = scale[axis] ?? 0;
    const step = scale[axis + 3] ?? 0;
    for (let i = axis; i < 3 * count; i += 3) positions[i] = low + step * (grid[i] ?? 0);
  }
  return { count, keyframes, positions, colours: new Uint8Array(buffer, 32 + 6 * count, 3 * count) };
}

const HUES = [205, 28, 145, 330, 265, 55, 185, 10, 95, 300, 230, 40];

/** A colour for a class or recording, readable on both themes. */
export function hueColour(index: number, dark: boolean): [number, number, number] {
  const hue = (HUES[index % HUES.length] ?? 0) + 17 * Math.floor(index / HUES.length);
  return hsl(hue, dark ? 0.75 : 0.7, dark ? 0.66 : 0.36);
}

export function hsl(hue: number, saturation: number, lightness: number): [number, number, number] {
  const k = (n: number): number => (n + hue / 30) % 12;
  const a = saturation * Math.min(lightness, 1 - lightness);
  const f = (n: number): number => lightness - a * Math.max(-1, Math.min(k(n) - 3, Math.min(9 - k(n), 1)));
  return [f(0), f(8), f(4)];
}

export function css([r, g, b]: readonly [number, number, number]): string {
  return `rgb(${Math.round(255 * r)} ${Math.round(255 * g)} ${Math.round(255 * b)})`;
}
