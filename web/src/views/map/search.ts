// The box that understands "cup near sink".
import { get, isAbort } from "../../api";
import { go, link, setQuery } from "../../router";
import type { Picked } from "../../scene/viewer";
import { texts } from "../../texts";
import type { FoundThings } from "../../types";
import { type Child, bdi, fill, h } from "../../ui/h";
import { failed, loading } from "../../ui/parts";
import type { MapContext } from "../map";

export interface Question {
  what: string;
  near?: string;
  on?: string;
  not_near?: string;
}

/** "cup not near sink" and the like: words before near, on, not near are what is wanted. */
export function questionOf(text: string): Question | null {
  const parts = text.trim().split(/\s+(not near|near|on)\s+/i);
  const what = (parts[0] ?? "").trim();
  if (what === "") return null;
  const question: Question = { what };
  for (let i = 1; i + 1 < parts.length; i += 2) {
    const name = (parts[i] ?? "").toLowerCase().replace(" ", "_") as "near" | "on" | "not_near";
    question[name] = (parts[i + 1] ?? "").trim();
  }
  return question;
}

export class Search {
  readonly element: HTMLElement;
  private readonly input: HTMLInputElement;
  private readonly results = h("div", { class: "results", attrs: { "aria-live": "polite" } });
  private asked: string | null = null;
  private asking = new AbortController();

  constructor(
    private readonly context: MapContext,
    private readonly select: (what: Picked, replace?: boolean) => void,
  ) {
    this.input = h("input", { attrs: { type: "search", placeholder: texts.search.placeholder, "aria-label": texts.search.label, autocomplete: "off" } });
    const form = h(
      "form",
      {
        class: "search",
        attrs: { role: "search" },
        on: {
          submit: (event) => {
            event.preventDefault();
            const text = this.input.value.trim();
            if (text === this.asked) this.asked = null; // again: fly there again
            if (text === "") this.clear();
            else if (new URLSearchParams(location.search).get("q") === text) this.follow(new URLSearchParams(location.search));
            else go(link(["maps", context.name], { ...Object.fromEntries(new URLSearchParams(location.search)), q: text, at: null }));
          },
        },
      },
      this.input,
      h("button", { class: "button", attrs: { type: "submit" }, title: texts.search.label }, "↵"),
    );
    this.element = h("div", { class: "search-box" }, form, this.results);
  }

  focus(): void {
    this.input.focus();
    this.input.select();
  }

  private clear(): void {
    setQuery({ q: null });
  }

  /** The question of the address. */
  follow(query: URLSearchParams): void {
    const text = query.get("q") ?? "";
    if (text === (this.asked ?? "")) return;
    this.asked = text;
    this.input.value = text;
    this.asking.abort();
    this.asking = new AbortController();
    const question = questionOf(text);
    if (question === null) {
      fill(this.results);
      return;
    }
    void this.ask(question, this.asking.signal);
  }

  private async ask(question: Question, until: AbortSignal): Promise<void> {
    fill(this.results, loading());
    const parameters = new URLSearchParams({ ...question, map: this.context.name, limit: "50" });
    try {
      const found = await get<FoundThings>(`/v1/find?${parameters}`, until);
      if (until.aborted) return;
      fill(this.results, this.shown(found));
      const best = found.hits[0];
      const selected = /\/(keyframes|landmarks)\//.test(location.pathname);
      if (best && !selected) this.select({ kind: "landmark", id: best.landmark }, true);
    } catch (error) {
      if (!until.aborted && !isAbort(error)) fill(this.results, failed(error, () => void this.ask(question, until)));
    }
  }

  private shown(found: FoundThings): Child[] {
    const understood = Object.entries(found.understood)
      .filter(([, item]) => item.how !== "class" || item.classes.join() !== item.said)
      .map(([, item]) => h("p", { class: "faint small" }, texts.search.understood(item.said, item.classes.join(", ") || "–")));
    const clear = h("button", { class: "linklike", attrs: { type: "button" }, on: { click: () => this.clear() } }, texts.search.clear);
    const hits = this.hits(found.hits.map((hit) => ({ id: hit.landmark, category: hit.category, note: texts.search.score(hit.score) })));
    if (found.missing) {
      const { missing } = found;
      return [
        ...understood,
        h("div", { class: "miss", attrs: { role: "status" } }, !found.hits.length && h("strong", null, texts.search.none), h("p", { attrs: { dir: "auto" } }, missing.text)),
        found.hits.length > 0 && hits,
        missing.candidates.length > 0 && h("p", { class: "small faint" }, texts.search.candidates),
        this.hits(missing.candidates.map((item) => ({ id: item.landmark ?? 0, category: item.category ?? "", note: "" }))),
        missing.usual_places.length > 0 &&
          h("p", { class: "small faint" }, texts.search.usual, " ", missing.usual_places.map((item) => `${texts.landmark.kinds[item.relation ?? ""] ?? item.relation ?? ""} ${item.category} (${item.count}×)`).join(", ")),
        clear,
      ];
    }
    return [
      ...understood,
      h("p", { class: "row small" }, h("strong", { class: "grow" }, texts.search.hits(found.hits.length)), clear),
      hits,
    ];
  }

  private hits(items: readonly { id: number; category: string; note: string }[]): HTMLElement {
    return h(
      "ol",
      { class: "hits" },
      items.map((item) =>
        h(
          "li",
          null,
          h("button", { class: "hit", attrs: { type: "button" }, on: { click: () => this.select({ kind: "landmark", id: item.id }) } }, h("span", { class: "grow" }, bdi(item.category)), h("span", { class: "faint small" }, item.note)),
        ),
      ),
    );
  }
}
