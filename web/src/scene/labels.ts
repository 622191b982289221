// Names beside things: text over the picture, as many as have room.
import type { Vector3 } from "../types";
import { h } from "../ui/h";

export interface Label {
  id: number;
  key: string;
  text: string;
  at: Vector3;
  colour: string;
  weight: number;
}

const MOST = 60;

export class Labels {
  readonly element = h("div", { class: "labels", attrs: { "aria-hidden": "true" } });
  private readonly made = new Map<string, HTMLElement>();
  private readonly sizes = new Map<string, [number, number]>();

  /** Places the heaviest labels that do not cover each other. `project`: pixels, or null behind the camera. */
  draw(labels: readonly Label[], project: (at: Vector3) => { x: number; y: number; far: number } | null, width: number, height: number, most = MOST): void {
    const seen = labels
      .map((label) => ({ label, spot: project(label.at) }))
      .filter((one) => one.spot !== null && one.spot.x > 0 && one.spot.x < width && one.spot.y > 0 && one.spot.y < height)
      .map((one) => ({ label: one.label, spot: one.spot as { x: number; y: number; far: number }, rank: one.label.weight / (0.5 + (one.spot?.far ?? 0)) }))
      .sort((a, b) => b.rank - a.rank)
      .slice(0, 4 * MOST);
    const taken: [number, number, number, number][] = [];
    const shown = new Set<string>();
    for (const { label, spot } of seen) {
      if (shown.size >= most) break;
      const [w, tall] = this.sizes.get(label.text) ?? [14 + 7.2 * label.text.length, 20];
      const box: [number, number, number, number] = [spot.x - w / 2, spot.y - tall, spot.x + w / 2, spot.y];
      if (taken.some((other) => box[0] < other[2] && box[2] > other[0] && box[1] < other[3] && box[3] > other[1])) continue;
      taken.push(box);
      shown.add(label.key);
      let element = this.made.get(label.key);
      if (!element) {
        element = h("span", { class: "label", attrs: { dir: "auto" } }, label.text);
        this.made.set(label.key, element);
        this.element.append(element);
        this.sizes.set(label.text, [element.offsetWidth, element.offsetHeight]);
      }
      element.style.transform = `translate(${Math.round(spot.x)}px, ${Math.round(spot.y)}px) translate(-50%, -100%)`;
      element.style.setProperty("--mark", label.colour);
      element.hidden = false;
    }
    for (const [key, element] of this.made) {
      if (shown.has(key)) continue;
      if (this.made.size > 400) {
        element.remove();
        this.made.delete(key);
      } else element.hidden = true;
    }
  }
}
