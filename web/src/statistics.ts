// Symmetric matrices of three rows, as covariances are: xx, xy, xz, yy, yz, zz.
import type { Vector3 } from "./types";

type Axis = 0 | 1 | 2;

/** Eigenvalues and vectors, by Jacobi's rotations. */
export function eigen(m: readonly number[]): { values: Vector3; vectors: [Vector3, Vector3, Vector3] } {
  const [xx = 0, xy = 0, xz = 0, yy = 0, yz = 0, zz = 0] = m;
  const a: [Vector3, Vector3, Vector3] = [
    [xx, xy, xz],
    [xy, yy, yz],
    [xz, yz, zz],
  ];
  const v: [Vector3, Vector3, Vector3] = [
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
  ];
  for (let sweep = 0; sweep < 12; sweep++) {
    for (const [p, q] of [[0, 1], [0, 2], [1, 2]] as [Axis, Axis][]) {
      if (Math.abs(a[p][q]) < 1e-15) continue;
      const angle = 0.5 * Math.atan2(2 * a[p][q], a[q][q] - a[p][p]);
      const c = Math.cos(angle);
      const s = Math.sin(angle);
      for (const k of [0, 1, 2] as Axis[]) {
        [a[k][p], a[k][q]] = [c * a[k][p] - s * a[k][q], s * a[k][p] + c * a[k][q]];
        [v[k][p], v[k][q]] = [c * v[k][p] - s * v[k][q], s * v[k][p] + c * v[k][q]];
      }
      for (const k of [0, 1, 2] as Axis[]) {
        [a[p][k], a[q][k]] = [c * a[p][k] - s * a[q][k], s * a[p][k] + c * a[q][k]];
      }
    }
  }
  const column = (k: Axis): Vector3 => [v[0][k], v[1][k], v[2][k]];
  return { values: [a[0][0], a[1][1], a[2][2]], vectors: [column(0), column(1), column(2)] };
}

export function eigen3(m: readonly number[]): Vector3 {
  return eigen(m).values;
}
