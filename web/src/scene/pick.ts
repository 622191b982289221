// What is at a place of the picture.
import { type Camera, Matrix4, Vector3 as V3 } from "three";
import { type KeyframeItem, type LandmarkItem, dot, plus, scaled } from "../model";
import type { Vector3 } from "../types";
import { present } from "./extent";

export type Picked = { kind: "keyframe"; id: number } | { kind: "landmark"; id: number } | null;

/** Where a ray enters a box, as a share of `along`; null where it does not. */
export function hitBox(from: Vector3, along: Vector3, item: Pick<LandmarkItem, "position" | "size" | "axes">): number | null {
  const start = plus(from, scaled(item.position, -1));
  let enters = 0;
  let leaves = Infinity;
  for (const axis of [0, 1, 2] as const) {
    const half = Math.max(item.size[axis] / 2, 0.02);
    const at = dot(start, item.axes[axis]);
    const speed = dot(along, item.axes[axis]);
    if (Math.abs(speed) < 1e-12) {
      if (Math.abs(at) > half) return null;
      continue;
    }
    const [one, two] = [(-half - at) / speed, (half - at) / speed];
    enters = Math.max(enters, Math.min(one, two));
    leaves = Math.min(leaves, Math.max(one, two));
  }
  return enters <= leaves ? enters : null;
}

/** The nearest keyframe within `reach` pixels, or the smallest thing whose box is hit: a cup, not its table. */
export function pick(camera: Camera, size: { width: number; height: number }, spot: { x: number; y: number; reach: number }, keyframes: readonly KeyframeItem[], landmarks: readonly LandmarkItem[]): Picked {
  const { width, height } = size;
  camera.updateMatrixWorld();
  const look = new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse.copy(camera.matrixWorld).invert());
  const seen = new V3();
  let best: Picked = null;
  let least = spot.reach;
  for (const item of keyframes) {
    seen.set(...item.position).applyMatrix4(look);
    if (seen.z > 1 || seen.z < -1) continue;
    const off = Math.hypot(((seen.x + 1) / 2) * width - spot.x, ((1 - seen.y) / 2) * height - spot.y);
    if (off < least) [least, best] = [off, { kind: "keyframe", id: item.id }];
  }
  if (best) return best;
  const [u, v] = [(2 * spot.x) / width - 1, 1 - (2 * spot.y) / height];
  const near = new V3(u, v, -1).unproject(camera);
  const far = new V3(u, v, 1).unproject(camera);
  const from: Vector3 = [near.x, near.y, near.z];
  const along: Vector3 = [far.x - near.x, far.y - near.y, far.z - near.z];
  let smallest = Infinity;
  for (const item of landmarks) {
    if (!present(item) || hitBox(from, along, item) === null) continue;
    const volume = Math.hypot(...item.size);
    if (volume < smallest) [smallest, best] = [volume, { kind: "landmark", id: item.id }];
  }
  return best;
}
