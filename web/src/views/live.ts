// Cameras that are tracked now, moving over the map.
import { ApiError, ask, part } from "../api";
import type { MapScene } from "../model";
import { type Context } from "../router";
import { texts } from "../texts";
import type { Pose, Vector3 } from "../types";
import { bdi, fill, h } from "../ui/h";
import { command, empty, failed, show } from "../ui/parts";
import { mapHead } from "../ui/tabs";
import { TopMap } from "../ui/topmap";
import { metres, place, sigmas } from "../ui/verdict";
import { cameraOf, sceneOfMap } from "./parts/evidence";

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

export function live({ root, until, params }: Context): void {
  const map = params["map"] ?? "";
  document.title = texts.title(`${texts.tabs.live} · ${map}`);
  root.className = "page";
  const place = h("div");
  root.append(mapHead(map, "live"), place);
  void show(place, until, async () => new Watching(map, await sceneOfMap(map, until), until).element);
}

class Watching {
  readonly element: HTMLElement;
  private readonly plan: TopMap;
  private readonly list = h("ul", { class: "plain stack", attrs: { "aria-label": texts.live.cameras } });
  private readonly note = h("div", { attrs: { role: "status" } });

  constructor(
    private readonly map: string,
    scene: MapScene,
    private readonly until: AbortSignal,
  ) {
    this.plan = new TopMap(scene);
    this.element = h("div", { class: "live" }, this.plan.element, h("div", { class: "stack" }, this.note, this.list));
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
    const kind = (one: Camera): string => (GOOD.includes(one.state) ? "localized" : one.pose ? "ambiguous" : "failed");
    this.plan.show(
      cameras.filter((one) => one.pose !== null).map((one) => cameraOf(one.pose as Pose, kind(one), one.covariance, one.camera)),
      [],
      [],
      new Set(),
      new Set(),
      cameras.map((one) => one.path),
    );
    fill(
      this.list,
      cameras.map((one) => {
        const sigma = sigmas(one.covariance);
        return h(
          "li",
          { class: "box" },
          h("div", { class: "row" }, h("strong", null, bdi(one.camera)), h("span", { class: `tag ${GOOD.includes(one.state) ? "good" : one.pose ? "warn" : "bad"}` }, one.state), h("span", { class: "faint" }, t.ago(one.age_s))),
          h("span", null, one.pose ? `${place(one.pose.position)} m${sigma ? ` ± ${metres(sigma.m)}` : ""}` : "–"),
          h("span", { class: "faint" }, t.frames(one.frames)),
          one.reason && h("span", { class: "faint", attrs: { dir: "auto" } }, one.reason),
        );
      }),
    );
  }
}
