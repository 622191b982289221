// A photo beside the best keyframe, with lines between the pixels that match.
import { load } from "../../api";
import { texts } from "../../texts";
import type { SeenObject } from "../../types";
import { bdi, h, svg } from "../../ui/h";

const MOST_LINES = 300;
const GAP = 12;

export interface Matches {
  keyframe: number;
  query_xy: [number, number][];
  keyframe_xy: [number, number][];
}

export async function matchesFigure(
  photo: Blob,
  objects: readonly SeenObject[],
  matches: Matches,
  keyframe: { camera: { width: number; height: number }; recording: string; frame_index: number },
  until: AbortSignal,
): Promise<HTMLElement> {
  const bitmap = await createImageBitmap(photo, { imageOrientation: "none" }); // pixels as stored, as the service has them
  const [width, height] = [bitmap.width, bitmap.height];
  bitmap.close();
  const { camera } = keyframe;
  const scale = height / camera.height; // both as high as each other
  const [other, left] = [camera.width * scale, width + GAP * (height / 240)];
  const url = URL.createObjectURL(photo);
  until.addEventListener("abort", () => URL.revokeObjectURL(url), { once: true });
  const own = h("img", { attrs: { alt: texts.matches.photo, src: url } });
  const best = h("img", { attrs: { alt: texts.matches.keyframe(keyframe.frame_index) } });
  load(best, `/v1/keyframes/${matches.keyframe}/image`, until);
  own.style.width = `${(100 * width) / (left + other)}%`;
  best.style.width = `${(100 * other) / (left + other)}%`;
  const lines = svg("svg", { class: "match-lines", viewBox: `0 0 ${left + other} ${height}`, "aria-hidden": "true" });
  const count = matches.query_xy.length;
  const step = Math.max(1, Math.ceil(count / MOST_LINES));
  for (let i = 0; i < count; i += step) {
    const [x1, y1] = matches.query_xy[i] ?? [0, 0];
    const [x2, y2] = matches.keyframe_xy[i] ?? [0, 0];
    const line = svg("path", { d: `M${x1.toFixed(1)} ${y1.toFixed(1)}L${(left + x2 * scale).toFixed(1)} ${(y2 * scale).toFixed(1)}` });
    line.style.stroke = `hsl(${(360 * i) / count} 90% 62%)`;
    lines.append(line);
  }
  for (const { box, category } of objects) {
    const [x1, y1, x2, y2] = box;
    lines.append(svg("rect", { class: "object", x: x1, y: y1, width: Math.max(1, x2 - x1), height: Math.max(1, y2 - y1) }, svg("title", {}, category)));
  }
  const toggle = h("input", { attrs: { type: "checkbox", checked: true }, on: { change: () => lines.classList.toggle("off") } });
  return h(
    "figure",
    { class: "matches" },
    h("div", { class: "pair" }, own, best, lines),
    h("figcaption", { class: "row" }, h("span", null, texts.matches.caption(count), bdi(keyframe.recording), texts.matches.frame(keyframe.frame_index)), h("label", { class: "inline" }, toggle, texts.matches.lines)),
  );
}
