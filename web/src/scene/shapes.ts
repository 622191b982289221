// Corners of what stands in a map.
import { type KeyframeItem, type LandmarkItem, plus, scaled } from "../model";
import type { Vector3 } from "../types";

/** The pyramid of what a camera sees, up to `depth` metres: its top, then the corners. */
export function frustum(item: Pick<KeyframeItem, "position" | "axes" | "camera">, depth: number): Vector3[] {
  const { width, height, fx, fy, cx, cy } = item.camera;
  const [right, down, forward] = item.axes;
  const corner = (u: number, v: number): Vector3 =>
    plus(item.position, plus(scaled(right, ((u - cx) / fx) * depth), plus(scaled(down, ((v - cy) / fy) * depth), scaled(forward, depth))));
  return [item.position, corner(0, 0), corner(width, 0), corner(width, height), corner(0, height)];
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
