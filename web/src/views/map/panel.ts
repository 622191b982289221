// Lists of what is in a map.
import { type KeyframeItem, type LandmarkItem, type MapScene, css, hueColour } from "../../model";
import type { Picked } from "../../scene/viewer";
import { setQuery } from "../../router";
import { texts } from "../../texts";
import { bdi, fill, h } from "../../ui/h";
import { VirtualList } from "../../ui/list";
import { command, empty } from "../../ui/parts";
import { theme } from "../../ui/theme";

type Tab = "things" | "frames";

export class Panel {
  readonly element = h("div", { class: "panel" });
  private readonly things: VirtualList<LandmarkItem>;
  private readonly frames: VirtualList<KeyframeItem>;
  private listed: { things: LandmarkItem[]; frames: KeyframeItem[] };
  private readonly body = h("div", { class: "panel-body", attrs: { role: "tabpanel" } });
  private readonly tabs: HTMLButtonElement[];
  private readonly filter: HTMLInputElement;
  private tab: Tab | null = null;
  private readonly usual: Tab;
  private marked: { keyframe?: number; landmark?: number } = {};

  constructor(
    private readonly scene: MapScene,
    chosen: (what: Picked) => void,
    until: AbortSignal,
  ) {
    const things = [...scene.landmarks].sort(byWeight);
    this.listed = { things, frames: scene.keyframes };
    this.things = new VirtualList<LandmarkItem>({ rowHeight: 44, label: texts.map.things, row: thingRow, chosen: (item) => chosen({ kind: "landmark", id: item.id }) });
    this.frames = new VirtualList<KeyframeItem>({ rowHeight: 44, label: texts.map.keyframes, row: frameRow, chosen: (item) => chosen({ kind: "keyframe", id: item.id }) });
    this.filter = h("input", { attrs: { type: "search" }, on: { input: () => this.filtered() } });
    this.tabs = (["things", "frames"] as const).map((name) =>
      h("button", { attrs: { type: "button", role: "tab" }, on: { click: () => setQuery({ list: name === this.usual ? null : name, filter: null }, false) } }, name === "things" ? texts.map.things : texts.map.keyframes),
    );
    this.element.append(h("div", { class: "panel-tabs", attrs: { role: "tablist" }, on: { keydown: (event) => this.turn(event) } }, this.tabs), h("div", { class: "panel-filter" }, this.filter), this.body);
    theme.watch(() => this.list(), until);
    this.usual = scene.landmarks.length > 0 || scene.keyframes.length === 0 ? "things" : "frames";
    this.follow(new URLSearchParams(location.search));
  }

  /** Which list, and what of it, is in the address. */
  follow(query: URLSearchParams): void {
    const named = query.get("list");
    const tab: Tab = named === "things" || named === "frames" ? named : this.usual;
    const wanted = query.get("filter") ?? "";
    if (tab === this.tab && wanted === this.filter.value) return;
    if (wanted !== this.filter.value) this.filter.value = wanted;
    this.open(tab);
  }

  /** Arrows go from tab to tab. */
  private turn(event: KeyboardEvent): void {
    if (event.key !== "ArrowLeft" && event.key !== "ArrowRight") return;
    event.preventDefault();
    const other = this.tabs[this.tab === "things" ? 1 : 0];
    other?.focus();
    other?.click();
  }

  private filtered(): void {
    setQuery({ filter: this.filter.value });
    this.list();
  }

  private open(tab: Tab): void {
    this.tab = tab;
    this.tabs.forEach((button, index) => button.setAttribute("aria-selected", String((index === 0) === (tab === "things"))));
    const label = tab === "things" ? texts.map.filter : texts.map.filterKeyframes;
    this.filter.placeholder = label;
    this.filter.setAttribute("aria-label", label);
    this.list();
  }

  private list(): void {
    const wanted = this.filter.value.trim().toLowerCase();
    if (this.tab === "things") {
      this.listed.things = this.scene.landmarks.filter((item) => item.category.toLowerCase().includes(wanted)).sort(byWeight);
      this.things.set(this.listed.things);
      if (this.scene.landmarks.length === 0) fill(this.body, empty(texts.map.noThings, [texts.map.noThingsHint, command(texts.map.noThingsCommand)]));
      else if (this.listed.things.length === 0) fill(this.body, empty(texts.map.noMatch));
      else if (this.things.element.parentElement !== this.body) fill(this.body, this.things.element);
    } else {
      this.listed.frames = this.scene.keyframes.filter((item) => `${item.recording} ${item.frameIndex}`.toLowerCase().includes(wanted));
      this.frames.set(this.listed.frames);
      if (this.frames.element.parentElement !== this.body) fill(this.body, this.frames.element);
    }
    this.mark(this.marked);
  }

  /** Shows which one is looked at. */
  mark(what: { keyframe?: number; landmark?: number }): void {
    this.marked = what;
    this.things.select(this.listed.things.findIndex((item) => item.id === what.landmark));
    this.frames.select(this.listed.frames.findIndex((item) => item.id === what.keyframe));
  }
}

function byWeight(a: LandmarkItem, b: LandmarkItem): number {
  const rank = (item: LandmarkItem): number => (item.state === "confirmed" ? 0 : item.state === "tentative" ? 1 : 2);
  return rank(a) - rank(b) || a.category.localeCompare(b.category) || b.keyframes - a.keyframes || a.id - b.id;
}

function thingRow(item: LandmarkItem): HTMLElement {
  const mark = h("span", { class: "dot" });
  mark.style.background = css(hueColour(item.categoryIndex, theme.get() === "dark"));
  const state = item.state === "confirmed" ? null : h("span", { class: `tag ${item.state === "gone" ? "bad" : "warn"}` }, item.state === "gone" ? texts.map.gone : texts.map.tentative);
  return h("div", null, mark, h("span", { class: "grow ellipsis" }, bdi(item.category)), state, h("span", { class: "faint small" }, texts.map.seenBy(item.keyframes)));
}

function frameRow(item: KeyframeItem): HTMLElement {
  const mark = h("span", { class: "dot square" });
  mark.style.background = css(hueColour(item.recordingIndex, theme.get() === "dark"));
  return h("div", null, mark, h("span", { class: "grow ellipsis" }, bdi(item.recording)), h("span", { class: "faint small" }, texts.map.frame(item.frameIndex)));
}
