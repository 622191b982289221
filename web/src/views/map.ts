// A map: in space or from above, its things and keyframes beside it, one of them in detail.
import { get, getBytes, isAbort, part } from "../api";
import { MOST_POINTS, type MapScene, type SceneColumns, pointsOf, sceneOf } from "../model";
import { type Context, type Updatable, go, link, setQuery } from "../router";
import type { Layer, Mode, Picked, Viewer } from "../scene/viewer";
import { texts } from "../texts";
import { bdi, fill, h } from "../ui/h";
import { key } from "../ui/keys";
import { a, button, command, copyLink, empty, loading, toast } from "../ui/parts";
import { theme } from "../ui/theme";
import { showKeyframe } from "./map/keyframe";
import { showLandmark } from "./map/landmark";
import { Panel } from "./map/panel";
import { Search } from "./map/search";

const LAYER_NAMES = Object.keys(texts.map.layers) as Layer[];
const OFF_AT_FIRST: readonly Layer[] = ["uncertainty"];

/** What the parts of the view share. */
export interface MapContext {
  name: string;
  scene: MapScene;
  until: AbortSignal;
  viewer: () => Viewer | null;
}

export async function map({ root, until, params, query }: Context): Promise<Updatable> {
  const name = params["map"] ?? "";
  document.title = texts.title(name);
  root.className = "map";
  fill(root, loading(texts.map.waiting));
  const asked = get<SceneColumns>(`/v1/maps/${part(name)}/scene`, until);
  // what comes after it is asked for early; the points not at the same time, or the service would work at both
  const viewer = import("../scene/viewer");
  const points = asked.then(() => getBytes(`/v1/maps/${part(name)}/points?count=${MOST_POINTS}`, until));
  for (const early of [viewer, points]) early.catch(() => undefined); // told where they are used
  const scene = sceneOf(await asked);
  const view = new MapView(name, scene, until, { viewer, points });
  if (until.aborted) return view;
  fill(root, view.element);
  view.update(params, query);
  void view.begin();
  return view;
}

/** What was asked for before the scene was there. */
interface Early {
  viewer: Promise<typeof import("../scene/viewer")>;
  points: Promise<ArrayBuffer>;
}

function modeOf(query: URLSearchParams): Mode {
  return query.get("view") === "top" ? "top" : "3d";
}

function offOf(query: URLSearchParams): Set<Layer> {
  return new Set(query.has("off") ? ((query.get("off") ?? "").split(",") as Layer[]) : OFF_AT_FIRST);
}

class MapView implements Updatable {
  readonly element: HTMLElement;
  private readonly stage = h("div", { class: "stage" });
  private readonly detail = h("aside", { class: "detail", attrs: { hidden: true, "aria-live": "polite", tabindex: -1 } });
  private readonly panel: Panel;
  private readonly search: Search;
  private readonly context: MapContext;
  private viewer: Viewer | null = null;
  private shown = "";
  private at = ""; // of the address, as it was last looked at or written
  private selecting = new AbortController();
  private off: Set<Layer>;
  private mode: Mode;
  private bar: HTMLElement;
  private readonly legend: HTMLElement;

  constructor(
    private readonly name: string,
    private readonly scene: MapScene,
    private readonly until: AbortSignal,
    private readonly early: Early,
  ) {
    const query = new URLSearchParams(location.search);
    this.mode = modeOf(query);
    this.off = offOf(query);
    this.context = { name, scene, until, viewer: () => this.viewer };
    this.panel = new Panel(scene, (what) => this.select(what), until);
    this.search = new Search(this.context, (what, replace) => this.select(what, replace));
    this.bar = this.toolbar();
    this.stage.append(this.bar);
    this.legend = h("p", { class: "legend" }, texts.map.legend.map(([kind, text]) => h("span", null, h("span", { class: `sign ${kind}`, attrs: { "aria-hidden": "true" } }), text)));
    const side = h("section", { class: "side", attrs: { "aria-label": texts.map.panel } }, this.head(), this.search.element, this.panel.element);
    this.element = h("div", { class: "map-view" }, side, this.stage, this.detail);
    this.stage.append(loading(texts.map.waiting));
    key("Escape", () => this.select(null), until);
    key("/", () => this.search.focus(), until);
    key("v", () => this.setMode(this.mode === "top" ? "3d" : "top"), until);
    key("h", () => this.viewer?.home(), until);
    until.addEventListener("abort", () => {
      this.selecting.abort();
      this.viewer?.dispose();
      this.viewer = null;
    });
  }

  private head(): HTMLElement {
    const { keyframes, landmarks, recordings } = this.scene;
    return h(
      "header",
      { class: "side-head" },
      h("h1", null, bdi(this.name)),
      h("p", { class: "faint" }, texts.map.summary(keyframes.length, landmarks.length, recordings.length)),
      h("nav", { class: "side-links", attrs: { "aria-label": texts.map.more } }, texts.map.pages.map(([page, text]) => a(link(["maps", this.name, page]), null, text))),
    );
  }

  async begin(): Promise<void> {
    if (this.scene.keyframes.length === 0) {
      fill(this.stage, empty(texts.map.empty, [texts.map.emptyHint, command(texts.map.emptyCommand(this.name))]));
      return;
    }
    try {
      const { Viewer } = await this.early.viewer;
      if (this.until.aborted) return;
      this.viewer = new Viewer(this.scene, { picked: (what) => this.select(what), moved: () => this.remember() }, this.off);
    } catch {
      fill(this.stage, empty(texts.map.noWebgl));
      return;
    }
    const { viewer } = this;
    Object.assign(viewer.element, { viewer }); // for those who measure
    viewer.canvas.setAttribute("aria-label", `${texts.map.scene(this.name)}. ${texts.map.sceneKeys}`);
    fill(this.stage, viewer.element, this.bar, this.legend);
    if (this.mode === "top") viewer.setMode("top");
    theme.watch(() => {
      viewer.build();
      this.highlight();
    }, this.until);
    this.look(new URLSearchParams(location.search));
    try {
      const points = pointsOf(await this.early.points);
      if (!this.until.aborted) viewer.setPoints(points);
    } catch (error) {
      if (!isAbort(error)) toast(texts.map.noPoints);
    }
    document.documentElement.dataset["ready"] = "map"; // for tests: all is drawn
  }

  update(params: Readonly<Record<string, string>>, query: URLSearchParams): boolean {
    if (params["map"] !== this.name) return false;
    this.search.follow(query);
    this.panel.follow(query);
    const turned = modeOf(query) !== this.mode;
    if (turned) this.applyMode(modeOf(query));
    this.applyOff(offOf(query));
    const wanted = `${params["keyframe"] ?? ""}/${params["landmark"] ?? ""}`;
    const other = wanted !== this.shown;
    if (other) {
      this.shown = wanted;
      this.showDetail(params);
      this.highlight();
    }
    if (other || turned || (query.get("at") ?? "") !== this.at) this.look(query);
    return true;
  }

  /** Goes to where the address says that one looks from: a place, what is selected, or all of the map. */
  private look(query: URLSearchParams): void {
    const { viewer } = this;
    if (!viewer) return;
    const before = this.at;
    this.at = query.get("at") ?? "";
    const at = this.at.split(",").map(Number);
    const [x, y, z, u, v, w, zoom] = at as [number, number, number, number, number, number, number];
    if (at.length === 7 && at.every(Number.isFinite)) viewer.state = { position: [x, y, z], target: [u, v, w], zoom };
    else if (this.shown !== "/") this.fly();
    else if (before !== "") viewer.home();
  }

  private params(): { keyframe?: number; landmark?: number } {
    const [keyframe, landmark] = this.shown.split("/");
    return { ...(keyframe ? { keyframe: Number(keyframe) } : {}), ...(landmark ? { landmark: Number(landmark) } : {}) };
  }

  private showDetail(params: Readonly<Record<string, string>>): void {
    this.selecting.abort();
    this.selecting = new AbortController();
    const until = this.selecting.signal;
    const { keyframe: keyframeId, landmark: landmarkId } = params;
    this.detail.hidden = keyframeId === undefined && landmarkId === undefined;
    this.element.classList.toggle("has-detail", !this.detail.hidden);
    this.panel.mark(this.params());
    if (this.detail.hidden) {
      document.title = texts.title(this.name);
      return;
    }
    const context = { ...this.context, until };
    const close = button("×", () => this.select(null), { class: "icon close", label: texts.close, title: `${texts.close} (Esc)` });
    const place = h("div", { class: "detail-body" });
    fill(this.detail, close, place);
    this.detail.scrollTop = 0;
    const keyframe = this.scene.keyframe(Number(keyframeId));
    const landmark = this.scene.landmark(Number(landmarkId));
    const lost = (title: string): void => fill(place, empty(title, texts.map.unknownHint, a(link(["maps", this.name]), null, texts.map.back)));
    if (keyframeId !== undefined && keyframe) {
      document.title = texts.title(`${texts.keyframe.title(keyframe.id)} · ${this.name}`);
      showKeyframe(context, keyframe, place);
    } else if (landmark) {
      document.title = texts.title(`${landmark.category} ${landmark.id} · ${this.name}`);
      showLandmark(context, landmark, place);
    } else lost(keyframeId !== undefined ? texts.map.unknownKeyframe(keyframeId) : texts.map.unknownLandmark(landmarkId ?? ""));
  }

  private highlight(): void {
    const { keyframe, landmark } = this.params();
    const one = keyframe === undefined ? undefined : this.scene.keyframe(keyframe);
    const thing = landmark === undefined ? undefined : this.scene.landmark(landmark);
    this.viewer?.highlight(one ? [one] : [], thing ? [thing] : []);
  }

  private fly(): void {
    const { keyframe, landmark } = this.params();
    const one = keyframe === undefined ? undefined : this.scene.keyframe(keyframe);
    const thing = landmark === undefined ? undefined : this.scene.landmark(landmark);
    this.highlight();
    if (thing) this.viewer?.flyToLandmark(thing);
    else if (one) this.viewer?.flyToKeyframe(one);
  }

  /** Goes to the address of what was clicked; the question and the layers stay. */
  private select(what: Picked, replace = false): void {
    const kept = Object.fromEntries(new URLSearchParams(location.search));
    if (what === null) return go(link(["maps", this.name], kept)); // one looks from where one looked
    delete kept["at"];
    go(link(["maps", this.name, what.kind === "keyframe" ? "keyframes" : "landmarks", what.id], kept), replace);
  }

  private remember(): void {
    if (!this.viewer || this.until.aborted) return;
    const { position, target, zoom } = this.viewer.state;
    this.at = [...position, ...target, zoom].map((value) => Number(value.toFixed(3))).join(",");
    setQuery({ at: this.at });
  }

  private setMode(mode: Mode): void {
    setQuery({ view: mode === "top" ? "top" : null, at: null }, false);
  }

  private applyMode(mode: Mode): void {
    this.mode = mode;
    this.viewer?.setMode(mode);
    this.renewBar();
  }

  private applyOff(off: ReadonlySet<Layer>): void {
    const changed = LAYER_NAMES.filter((layer) => off.has(layer) !== this.off.has(layer));
    if (changed.length === 0) return;
    this.off = new Set(off);
    for (const layer of changed) this.viewer?.show(layer, !off.has(layer));
    for (const layer of changed) {
      const box = this.bar.querySelector<HTMLInputElement>(`input[name="${layer}"]`);
      if (box) box.checked = !off.has(layer);
    }
  }

  private renewBar(): void {
    const open = this.bar.querySelector("details")?.open ?? false;
    const anew = this.toolbar();
    const layers = anew.querySelector("details");
    if (layers) layers.open = open;
    const focused = this.bar.contains(document.activeElement);
    this.bar.replaceWith(anew);
    this.bar = anew;
    if (focused) anew.querySelector<HTMLElement>("[aria-pressed=true]")?.focus();
  }

  private toolbar(): HTMLElement {
    const modes = h(
      "div",
      { class: "segmented", attrs: { role: "group" } },
      (["3d", "top"] as const).map((mode) =>
        h(
          "button",
          { attrs: { type: "button", "aria-pressed": String(mode === this.mode) }, on: { click: () => this.setMode(mode) }, title: "v" },
          mode === "3d" ? texts.map.view3d : texts.map.viewTop,
        ),
      ),
    );
    const boxes = LAYER_NAMES.map((layer) =>
      h(
        "label",
        { class: "inline" },
        h("input", {
          attrs: { type: "checkbox", name: layer, checked: !this.off.has(layer) },
          on: { change: (event) => this.toggle(layer, (event.target as HTMLInputElement).checked) },
        }),
        h("span", { class: `swatch ${layer}`, attrs: { "aria-hidden": "true" } }),
        texts.map.layers[layer],
      ),
    );
    const layers = h("details", { class: "layers" }, h("summary", { class: "button" }, texts.map.layersLabel), h("div", { class: "layer-list" }, boxes));
    const share = button(texts.map.share, () => void copyLink(), { class: "button quiet" });
    return h("div", { class: "toolbar" }, modes, button(texts.map.home, () => this.viewer?.home(), { title: "h" }), layers, share);
  }

  private toggle(layer: Layer, on: boolean): void {
    const off = new Set(this.off);
    if (on) off.delete(layer);
    else off.add(layer);
    const usual = off.size === OFF_AT_FIRST.length && OFF_AT_FIRST.every((name) => off.has(name));
    setQuery({ off: usual ? null : [...off].join(",") || "none" }, false);
  }
}

