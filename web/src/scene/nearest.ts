// Of very many things those near the eye get edges; all others are dots.
import { BufferAttribute, type Camera, Frustum, type LineSegments, Matrix4, Vector3 as V3 } from "three";
import type { Vector3 } from "../types";

/** Puts the items nearest to the eye first into the index of `edges`. Gives how many there are then. */
export function nearestFirst(edges: LineSegments, items: readonly { position: Vector3 }[], vertices: number, camera: Camera, most: number): number {
  camera.updateMatrixWorld();
  const inverse = new Matrix4().copy(camera.matrixWorld).invert();
  const seen = new Frustum().setFromProjectionMatrix(new Matrix4().multiplyMatrices(camera.projectionMatrix, inverse));
  const eye = new V3().setFromMatrixPosition(camera.matrixWorld);
  const spot = new V3();
  const near: [number, number][] = [];
  items.forEach((item, k) => {
    spot.set(...item.position);
    if (seen.containsPoint(spot)) near.push([spot.distanceToSquared(eye), k]);
  });
  near.sort((a, b) => a[0] - b[0]);
  const chosen = near.slice(0, most);
  const index = new Uint32Array(chosen.length * vertices);
  chosen.forEach(([, k], n) => {
    for (let i = 0; i < vertices; i++) index[n * vertices + i] = k * vertices + i;
  });
  const known = edges.geometry.getIndex();
  if (known && known.count >= most * vertices) {
    (known.array as Uint32Array).set(index);
    known.needsUpdate = true;
  } else {
    const room = new Uint32Array(most * vertices);
    room.set(index);
    edges.geometry.setIndex(new BufferAttribute(room, 1));
  }
  return chosen.length;
}
