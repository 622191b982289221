// Photos to poses: what was dropped is localized one after the other, and each answer shown with what it rests on.
import { ApiError, ask, get, getAll, part } from "../api";
import { type Dropped, type Photo, chosenFiles, dropped } from "../drop";
import { type Context, type Updatable, go, link } from "../router";
import { texts } from "../texts";
import type { MapInfo, Pose, SeenObject } from "../types";
import { bdi, fill, h } from "../ui/h";
import { key } from "../ui/keys";
import { quoted } from "../ui/quoted";
import { a, button, command, empty, failed, show } from "../ui/parts";
import { mapHead } from "../ui/tabs";
import { verdictTag, verdictWords } from "../ui/verdict";
import { type Candidate, candidatesTable, matchedOf, poseFacts, sceneOfMap } from "./parts/evidence";
import { matchesFigure } from "./parts/matches";
import { type Placed, Space } from "./parts/space";

interface Answer {
  image: string;
  verdict: string;
  map: string;
  pose: Pose | null;
  covariance: number[][] | null;
  confidence: number | null;
  inliers: number;
  reason: string;
  candidates: Candidate[];
  objects: SeenObject[];
  notes: string[];
  timing_ms: Record<string, number | null>;
  matches: { keyframe: number; query_xy: [number, number][]; keyframe_xy: [number, number][] } | null;
}

interface Result {
  photo: Photo;
  answer: Answer | null;
  error: unknown;
}

interface Recording {
  name: string;
}

/** Which map the photos are for: where there is one, it is that. */
export async function locateAnywhere({ root, until }: Context): Promise<void> {
  root.className = "page";
  document.title = texts.title(texts.tabs.locate);
  const maps = await getAll<MapInfo>("/v1/maps", until);
  if (maps.length === 1 && maps[0]) {
    go(link(["maps", maps[0].name, "locate"]), true);
    return;
  }
  fill(
    root,
    h("h1", null, texts.locate.whichMap),
    maps.length === 0 ? empty(texts.maps.none) : h("ul", { class: "plain stack" }, maps.map((map) => h("li", null, a(link(["maps", map.name, "locate"]), { class: "button" }, bdi(map.name))))),
  );
}

export function locate({ root, until, params }: Context): Updatable {
  const map = params["map"] ?? "";
  document.title = texts.title(`${texts.tabs.locate} · ${map}`);
  root.className = "page";
  const results = h("div", { class: "results" });
  const state = new Locating(map, results, until);
  root.append(mapHead(map, "locate"), state.form(), results);
  dropped.watch((found) => {
    if (found === null) return;
    dropped.set(null);
    void state.take(found);
  }, until);
  if (results.childElementCount === 0) fill(results, empty(texts.locate.none, texts.locate.noneHint, [texts.locate.command, command(`semdb localize photo.jpg --map ${quoted(map)}`)]));
  return {
    update: (next, query) => {
      if (next["map"] !== map) return false;
      state.space?.follow(query);
      return true;
    },
  };
}

class Locating {
  space: Space | null = null;
  private results: Result[] = [];
  private chosen = 0;
  private camera = "";
  private like = "";
  private log = true;
  private busy = new AbortController();
  private last: Dropped | null = null;
  private readonly list = h("ol", { class: "result-list", attrs: { "aria-label": texts.locate.photos } });
  private readonly detail = h("div", { class: "result-detail", attrs: { "aria-live": "polite" } });
  private readonly progress = h("p", { class: "faint", attrs: { role: "status" } });

  constructor(
    private readonly map: string,
    private readonly place: HTMLElement,
    private readonly until: AbortSignal,
  ) {
    until.addEventListener("abort", () => this.busy.abort());
    key("j", () => this.choose(this.chosen + 1), until);
    key("k", () => this.choose(this.chosen - 1), until);
  }

  form(): HTMLElement {
    const t = texts.locate;
    const pick = (folder: boolean): HTMLInputElement => {
      const input = h("input", { class: "file", attrs: { type: "file", multiple: true, accept: folder ? null : "image/png,image/jpeg", webkitdirectory: folder, "aria-label": folder ? t.folder : t.choose } });
      input.addEventListener("change", () => {
        if (input.files && input.files.length > 0) void chosenFiles(input.files).then((found) => this.take(found));
        input.value = "";
      });
      return input;
    };
    const files = pick(false);
    const folder = pick(true);
    const like = h("select", { attrs: { name: "like" } }, h("option", { attrs: { value: "" } }, t.likeKeyframes));
    like.addEventListener("change", () => (this.like = like.value));
    getAll<Recording>(`/v1/recordings?map=${part(this.map)}`, this.until, 500)
      .then((found) => like.append(...found.map((one) => h("option", { attrs: { value: one.name } }, t.like(one.name)))))
      .catch(() => undefined);
    const camera = h("input", { attrs: { name: "camera", placeholder: "fx,fy,cx,cy", spellcheck: "false", autocomplete: "off" } });
    camera.addEventListener("input", () => {
      this.camera = camera.value.trim();
      like.disabled = this.camera !== "";
    });
    const log = h("input", { attrs: { type: "checkbox", checked: true } });
    log.addEventListener("change", () => (this.log = log.checked));
    return h(
      "section",
      { class: "drop-zone", attrs: { "aria-label": t.zone } },
      h("div", { class: "row" }, h("strong", null, t.zone), h("label", { class: "button primary" }, t.choose, files), h("label", { class: "button" }, t.folder, folder)),
      h("div", { class: "filters" }, h("label", null, t.cameraOf, like), h("label", null, t.camera, camera), h("label", { class: "inline" }, log, t.log), button(t.again, () => this.last && void this.take(this.last))),
    );
  }

  async take(found: Dropped): Promise<void> {
    if (found.photos.length === 0) return;
    this.busy.abort();
    this.busy = new AbortController();
    const { signal } = this.busy;
    this.last = found;
    this.results = found.photos.map((photo) => ({ photo, answer: null, error: null }));
    this.chosen = 0;
    const stop = button(texts.locate.stop, () => this.busy.abort());
    fill(this.place, h("div", { class: "row" }, this.progress, stop), h("div", { class: "located" }, h("div", { class: "stack" }, this.list), this.detail));
    fill(this.detail);
    for (const [index, result] of this.results.entries()) {
      this.progress.textContent = texts.locate.progress(index, this.results.length);
      this.draw();
      try {
        result.answer = await this.ask(result.photo, found, signal);
      } catch (error) {
        if (signal.aborted) break;
        result.error = error;
        if (error instanceof ApiError && [0, 401, 403, 404, 409].includes(error.status)) {
          this.choose(index);
          break; // it would be the same for all others
        }
      }
      this.draw();
      if (index === this.chosen) this.choose(index);
    }
    if (this.busy.signal !== signal) return; // others were dropped meanwhile: what is shown is theirs
    stop.remove();
    const done = this.results.filter((one) => one.answer !== null);
    this.progress.textContent = texts.locate.done(done.filter((one) => one.answer?.verdict === "localized").length, this.results.length);
    this.draw();
  }

  private async ask(photo: Photo, { categories, camera }: Dropped, signal: AbortSignal): Promise<Answer> {
    const form = new FormData();
    form.append("image", photo.file);
    form.append("name", photo.name.slice(-255));
    form.append("matches", "true");
    form.append("log", String(this.log));
    if (this.camera) form.append("camera", this.camera);
    else if (this.like) form.append("like", this.like);
    else if (camera !== null) form.append("camera", camera);
    if (photo.instances && categories !== null) {
      form.append("instances", photo.instances);
      form.append("categories", categories);
    }
    const answer = await ask(`/v1/maps/${part(this.map)}/localize`, { method: "POST", body: form, until: signal });
    return (await answer.json()) as Answer;
  }

  private draw(): void {
    fill(
      this.list,
      this.results.map((result, index) => {
        const told = result.answer ? verdictTag(result.answer.verdict) : result.error ? h("span", { class: "tag bad" }, texts.locate.refused) : h("span", { class: "faint" }, "…");
        const made = h("button", { class: "result", attrs: { type: "button", "aria-current": index === this.chosen ? "true" : null }, on: { click: () => this.choose(index) } }, bdi(result.photo.name.split("/").at(-1) ?? ""), told);
        return h("li", null, made);
      }),
    );
  }

  private choose(index: number): void {
    const result = this.results[index];
    if (!result) return;
    this.chosen = index;
    this.draw();
    if (result.error) fill(this.detail, this.refusal(result.error));
    else if (result.answer) void show(this.detail, this.until, () => this.answer(result, result.answer as Answer));
  }

  private refusal(error: unknown): HTMLElement {
    const shown = failed(error, () => this.last && void this.take(this.last));
    const detail = error instanceof Error ? error.message : "";
    if (/camera/.test(detail)) shown.append(h("p", null, texts.locate.needsCamera));
    return shown;
  }

  private async answer(result: Result, found: Answer): Promise<HTMLElement> {
    const t = texts.locate;
    const scene = await sceneOfMap(this.map, this.until);
    const space = (this.space ??= new Space(scene, this.until));
    const others = this.results.flatMap((one): Placed[] => (one !== result && one.answer?.pose ? [{ pose: one.answer.pose, verdict: one.answer.verdict, faint: true }] : []));
    const matched = matchedOf(scene, found.candidates);
    const own: Placed | null = found.pose && { pose: found.pose, verdict: found.verdict, label: t.here, covariance: found.covariance, camera: this.camera || (this.last?.camera ?? ""), by: matched.slice(0, 3) };
    space.show([...others, ...(own ? [own] : [])], matched);
    if (own) space.flyTo(own);
    const best = found.matches ? await get<{ camera: { width: number; height: number }; recording: string; frame_index: number }>(`/v1/keyframes/${found.matches.keyframe}`, this.until).catch(() => null) : null;
    return h(
      "div",
      { class: "stack" },
      h("div", { class: "verdict-head" }, verdictTag(found.verdict), h("strong", null, verdictWords(found.verdict))),
      h("p", { attrs: { dir: "auto" } }, t.because(found.reason)),
      best && found.matches ? await matchesFigure(result.photo.file, found.objects, found.matches, best, this.until) : h("p", { class: "faint" }, t.noMatches),
      h("div", { class: "answer" }, space.element, h("div", { class: "stack" }, poseFacts(found.pose, found.covariance, found.confidence, found.inliers), found.pose && this.into3d(found.pose), found.notes.length > 0 && h("div", { class: "notes" }, h("h3", null, t.assumed), h("ul", null, found.notes.map((note) => h("li", { attrs: { dir: "auto" } }, note)))))),
      candidatesTable(this.map, found.candidates),
    );
  }

  /** The map in space, seen from where the photo was taken. */
  private into3d(pose: Pose): HTMLElement {
    const [w, x, y, z] = pose.quat_wxyz;
    const forward = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)];
    const target = pose.position.map((value, k) => value + (forward[k] ?? 0));
    const at = [...pose.position, ...target, 1].map((value) => value.toFixed(3)).join(",");
    return h("p", null, a(link(["maps", this.map], { at }), { class: "button" }, texts.locate.lookFromThere));
  }
}
