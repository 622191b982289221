// Rays and boxes.
import { type LandmarkItem, dot, plus, scaled } from "../model";
import type { Vector3 } from "../types";

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
