// Cameras that are tracked now, moving over the map.
import { ApiError, ask, part } from "../api";
import type { MapScene } from "../model";
import type { Context, Updatable } from "../router";
import { texts } from "../texts";
import type { Pose, Vector3 } from "../types";
import { bdi, fill, h } from "../ui/h";
import { button, command, empty, failed, show } from "../ui/parts";
import { mapHead } from "../ui/tabs";
import { metres, place, sigmas } from "../ui/verdict";
import { sceneOfMap } from "./parts/evidence";
import { type Placed, Space } from "./parts/space";

interface Camera {
  camera: string;
  frames: number;
  age_s: number;
  path: Vector3[];
  state: string;
  pose: Pose | null;
  covariance: number[][] | null;
  reason: string | null;
}

const AGAIN_MS = 2000;
const GOOD = ["tracking", "tracked", "localized"];

export function live({ root, until, params }: Context): Updatable {
  const map = params["map"] ?? "";
  document.title = texts.title(`${texts.tabs.live} · ${map}`);
  root.className = "page";
  const place = h("div");
  root.append(mapHead(map, "live"), place);
  let watching: Watching | null = null;
  void show(place, until, async () => {
    const scene = await sceneOfMap(map, until);
    if (scene.keyframes.length === 0) return empty(texts.map.empty, [texts.map.emptyHint, command(texts.map.emptyCommand(map))]);
    watching = new Watching(map, scene, until);
    return watching.element;
  });
  return {
    update: (next, query) => {
      if (next["map"] !== map) return false;
      watching?.space.follow(query);
      return true;
    },
  };
}

class Watching {
  readonly element: HTMLElement;
  readonly space: Space;
  private readonly rows = new Map<string, Row>();
  private readonly list = h("ul", { class: "plain stack", attrs: { "aria-label": texts.live.cameras } });
  private readonly note = h("div", { attrs: { role: "status" } });

  constructor(
    private readonly map: string,
    scene: MapScene,
    private readonly until: AbortSignal,
  ) {
    this.space = new Space(scene, until);
    this.element = h("div", { class: "live" }, this.space.element, h("div", { class: "stack" }, this.note, this.list));
    this.draw([]);
    void this.follow();
  }

  /** Server-sent events by fetch: EventSource sends no token. */
  private async follow(): Promise<void> {
    while (!this.until.aborted) {
      try {
        const answer = await ask(`/v1/maps/${part(this.map)}/live/events`, { until: this.until });
        const reader = answer.body?.pipeThrough(new TextDecoderStream()).getReader();
        let text = "";
        for (;;) {
          const piece = await reader?.read();
          if (!piece || piece.done) break;
          text += piece.value;
          const events = text.split("\n\n");
          text = events.pop() ?? "";
          for (const event of events) {
            const data = event.split("\n").find((line) => line.startsWith("data: "));
            if (data) this.draw((JSON.parse(data.slice(6)) as { cameras: Camera[] }).cameras);
          }
        }
      } catch (error) {
        if (this.until.aborted) return;
        if (error instanceof ApiError && [401, 403, 404].includes(error.status)) {
          fill(this.note, failed(error, () => void this.follow()));
          return; // it would be the same the next time
        }
        fill(this.note, h("p", { class: "error-text" }, texts.live.lost));
      }
      await new Promise((done) => setTimeout(done, AGAIN_MS));
    }
  }

  private draw(cameras: readonly Camera[]): void {
    const t = texts.live;
    fill(this.note, cameras.length === 0 && empty(t.none, [t.noneHint, command(t.command(this.map, location.origin))]));
    this.space.show(cameras.flatMap(placed));
    const gone = new Set(this.rows.keys());
    for (const one of cameras) {
      gone.delete(one.camera);
      let row = this.rows.get(one.camera);
      if (!row) {
        row = new Row(one.camera, (last) => placed(last).forEach((found) => this.space.flyTo(found)));
        this.rows.set(one.camera, row);
        this.list.append(row.element);
        if (this.rows.size === 1 && !new URLSearchParams(location.search).has("at")) row.fly(one);
      }
      row.show(one);
    }
    for (const name of gone) {
      this.rows.get(name)?.element.remove();
      this.rows.delete(name);
    }
  }
}

function placed(one: Camera): Placed[] {
  const verdict = GOOD.includes(one.state) ? "localized" : one.pose ? "ambiguous" : "failed";
  return one.pose ? [{ pose: one.pose, verdict, label: one.camera, covariance: one.covariance, path: one.path }] : [];
}

/** What is said of a camera; it stays while that changes, so that its button keeps the focus. */
class Row {
  readonly element: HTMLElement;
  private readonly told = h("div", { class: "stack tight" });
  private last: Camera | null = null;

  constructor(
    name: string,
    readonly fly: (last: Camera) => void,
  ) {
    const there = button(texts.landmark.fly, () => this.last && fly(this.last), { label: texts.live.flyTo(name) });
    this.element = h("li", { class: "box" }, h("div", { class: "row" }, h("strong", { class: "grow" }, bdi(name)), there), this.told);
  }

  show(one: Camera): void {
    this.last = one;
    const sigma = sigmas(one.covariance);
    const t = texts.live;
    fill(
      this.told,
      h("div", { class: "row" }, h("span", { class: `tag ${GOOD.includes(one.state) ? "good" : one.pose ? "warn" : "bad"}` }, one.state), h("span", { class: "faint" }, t.ago(one.age_s))),
      h("span", null, one.pose ? `${place(one.pose.position)} m${sigma ? ` ± ${metres(sigma.m)}` : ""}` : "–"),
      h("span", { class: "faint" }, t.frames(one.frames)),
      one.reason && h("span", { class: "faint", attrs: { dir: "auto" } }, one.reason),
    );
  }
}
