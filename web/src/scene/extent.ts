// How large a map is, and what follows from that.
import { type LandmarkItem, type MapScene, type PointCloud, distance, dot } from "../model";
import type { Vector3 } from "../types";

export function present(item: LandmarkItem): boolean {
  return item.state !== "gone";
}

export class Extent {
  centre: Vector3 = [0, 0, 0];
  radius = 2;
  /** Height above which nothing is shown from above: a little over the heads. */
  ceiling = Infinity;

  constructor(
    private readonly scene: MapScene,
    private readonly cloud: PointCloud | null,
  ) {
    const places = [...scene.keyframes.map((item) => item.position), ...scene.landmarks.filter(present).map((item) => item.position)];
    if (scene.keyframes.length === 0 || places.length === 0) places.push(...this.someOfCloud(2000));
    if (places.length === 0) return;
    const middle = (axis: 0 | 1 | 2): number => {
      const sorted = places.map((place) => place[axis]).sort((a, b) => a - b);
      return ((sorted[Math.floor(0.02 * sorted.length)] ?? 0) + (sorted[Math.ceil(0.98 * sorted.length) - 1] ?? 0)) / 2;
    };
    this.centre = [middle(0), middle(1), middle(2)];
    const far = places.map((place) => distance(place, this.centre)).sort((a, b) => a - b);
    this.radius = Math.max(0.8, 1.15 * (far[Math.floor(0.97 * (far.length - 1))] ?? 1));
    const heights = scene.keyframes.map((item) => dot(item.position, scene.up)).sort((a, b) => a - b);
    this.ceiling = (heights[Math.floor(heights.length / 2)] ?? Infinity) + 0.35;
  }

  private someOfCloud(most: number): Vector3[] {
    const { cloud } = this;
    if (!cloud) return [];
    return Array.from({ length: Math.min(cloud.count, most) }, (_, i): Vector3 => [cloud.positions[3 * i] ?? 0, cloud.positions[3 * i + 1] ?? 0, cloud.positions[3 * i + 2] ?? 0]);
  }

  /** How far the pyramids of keyframes reach, metres. */
  get frustumSize(): number {
    const crowd = Math.cbrt(Math.max(1, this.scene.keyframes.length / 60));
    return Math.max(0.04, Math.min(0.16, 0.05 * this.radius) / Math.min(crowd, 3));
  }

  /** About as large as points are apart, metres. */
  get pointSize(): number {
    return this.cloud ? Math.min(0.06, Math.max(0.006, (2.5 * this.radius) / Math.sqrt(this.cloud.count))) : 0.02;
  }

  /** Height of the floor. */
  get floor(): number {
    const { up } = this.scene;
    const heights = [...this.someOfCloud(5000).map((place) => dot(place, up)), ...this.scene.landmarks.map((item) => dot(item.position, up) - item.size[2] / 2)];
    if (heights.length === 0) return dot(this.centre, up) - 1;
    heights.sort((a, b) => a - b);
    return heights[Math.floor(0.01 * heights.length)] ?? 0;
  }
}
