// Numbers and times as people read them.
import type { Vector3 } from "../../types";
import { type Child, h } from "../../ui/h";

export function facts(rows: readonly (readonly [string, Child])[]): HTMLElement {
  return h("dl", { class: "facts" }, rows.filter(([, value]) => value !== null && value !== "").map(([name, value]) => [h("dt", null, name), h("dd", null, value)]));
}

export function metres(place: Vector3): string {
  return `${place.map((value) => value.toFixed(2)).join(", ")} m`;
}

/** A time of a recording. Clocks of robots that began at 0 give seconds. */
export function when(ns: number | null): string {
  if (ns === null) return "–";
  if (Math.abs(ns) < 1e17) return `${(ns / 1e9).toFixed(2)} s`;
  return new Date(ns / 1e6).toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "medium" });
}
