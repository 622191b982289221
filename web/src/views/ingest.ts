// Recordings into maps: by path or upload, how far each is, what failed, and once more.
import { ApiError, ask, get, getAll, part, token } from "../api";
import { type Context, link } from "../router";
import { texts } from "../texts";
import type { MapInfo } from "../types";
import { bdi, fill, h } from "../ui/h";
import { a, button, command, empty, failed, show, toast } from "../ui/parts";
import { mapHead } from "../ui/tabs";
import { moment } from "../ui/verdict";

interface Job {
  job: number;
  map: string;
  name: string;
  state: string;
  recordings: { recording: string; failed?: Record<string, string> }[];
  items: Record<string, number> | null;
  progress: { what: string; done: number; total: number } | null;
  error: string | null;
  created_at: string;
  finished_at: string | null;
}

interface Recording {
  id: number;
  map: string;
  name: string;
  state: string;
  frame_count: number;
  keyframes: number;
  items: Record<string, number>;
}

interface Sources {
  paths: boolean;
  entries: { path: string; kind: string; bytes: number | null }[];
}

const OPEN = ["waiting", "running", "working"];
const LOOK_MS = 1500;
const KINDS: Record<string, string> = { done: "good", failed: "bad", waiting: "", running: "warn", working: "warn" };

/** Of one map, or of all. */
export function ingest({ root, until, params }: Context): void {
  const map = params["map"] ?? null;
  document.title = texts.title(map === null ? texts.tabs.ingest : `${texts.tabs.ingest} · ${map}`);
  root.className = "page";
  const jobs = h("div");
  const recordings = h("div");
  const form = h("div");
  const followed = new Follow(map, jobs, recordings, until);
  root.append(
    map === null ? h("h1", null, texts.ingest.title) : mapHead(map, "ingest"),
    h("section", { class: "stack" }, h("h2", null, texts.ingest.add), form),
    h("section", { class: "stack" }, h("h2", null, texts.ingest.jobs), jobs),
    h("section", { class: "stack" }, h("h2", null, texts.ingest.recordings), recordings),
  );
  void show(form, until, async () => new Adding(map, await get<Sources>("/v1/ingest/sources", until), await getAll<MapInfo>("/v1/maps", until), until, () => void followed.look()).element);
  void followed.look();
  void followed.lookAtRecordings();
}

class Adding {
  readonly element: HTMLElement;
  private readonly mapName: HTMLInputElement;
  private readonly recording = h("input", { attrs: { name: "recording", autocomplete: "off", maxlength: 255, placeholder: texts.ingest.namePlaceholder } });
  private readonly keyframes = h("input", { attrs: { name: "keyframes", type: "number", min: 1, placeholder: texts.ingest.auto } });
  private readonly state = h("div", { attrs: { "aria-live": "polite" } });

  constructor(
    map: string | null,
    sources: Sources,
    maps: readonly MapInfo[],
    private readonly until: AbortSignal,
    private readonly begun: () => void,
  ) {
    const t = texts.ingest;
    this.mapName = h("input", { attrs: { name: "map", required: true, maxlength: 255, list: "map-names", value: map ?? maps[0]?.name ?? "", autocomplete: "off" } });
    const file = h("input", { class: "file", attrs: { type: "file", "aria-label": t.upload } });
    file.addEventListener("change", () => {
      const chosen = file.files?.[0];
      if (chosen) void this.upload(chosen);
      file.value = "";
    });
    const zone = h("div", { class: "drop-zone", attrs: { "data-drops": true } }, h("strong", null, t.dropHere), h("span", { class: "faint" }, t.dropHint), h("label", { class: "button" }, t.upload, file));
    zone.addEventListener("dragover", (event) => event.preventDefault());
    zone.addEventListener("drop", (event) => {
      event.preventDefault();
      const dropped = event.dataTransfer?.files[0];
      if (dropped) void this.upload(dropped);
    });
    this.element = h(
      "div",
      { class: "stack" },
      h("datalist", { id: "map-names" }, maps.map((one) => h("option", { attrs: { value: one.name } }))),
      h("div", { class: "filters" }, h("label", null, t.map, this.mapName), h("label", null, t.name, this.recording), h("label", null, t.keyframes, this.keyframes)),
      h("div", { class: "two" }, zone, this.sources(sources)),
      this.state,
    );
  }

  private sources(found: Sources): HTMLElement {
    const t = texts.ingest;
    if (!found.paths) return h("div", { class: "box" }, h("strong", null, t.noRoots), h("p", null, t.noRootsHint), command("SEMDB_SERVE_INGEST_ROOTS=/recordings semdb serve"));
    if (found.entries.length === 0) return h("div", { class: "box" }, h("strong", null, t.emptyRoots), h("p", null, t.emptyRootsHint));
    return h(
      "div",
      { class: "box" },
      h("strong", null, t.roots),
      h("ul", { class: "plain sources" }, found.entries.map((one) => h("li", { class: "row" }, h("span", { attrs: { "aria-hidden": "true" } }, one.kind === "folder" ? "▸" : "·"), bdi(one.path), one.bytes !== null && h("span", { class: "faint" }, size(one.bytes)), button(t.ingest, () => void this.begin({ path: one.path }), { label: t.ingestOf(one.path) })))),
    );
  }

  private async begin(what: { path: string } | { upload: string }): Promise<void> {
    const map = this.mapName.value.trim();
    if (map === "") {
      this.mapName.focus();
      return;
    }
    const json = { ...what, ...(this.recording.value.trim() ? { name: this.recording.value.trim() } : {}), ...(this.keyframes.value ? { keyframes: Number(this.keyframes.value) } : {}) };
    try {
      await ask(`/v1/maps/${part(map)}/ingest`, { method: "POST", json, until: this.until });
      fill(this.state);
      toast(texts.ingest.begun(map));
      this.begun();
    } catch (error) {
      if (!this.until.aborted) fill(this.state, failed(error));
    }
  }

  /** By XMLHttpRequest: fetch does not say how much was sent. */
  private async upload(file: File): Promise<void> {
    const bar = h("progress", { attrs: { max: 1, value: 0, "aria-label": texts.ingest.sending(file.name) } });
    const stop = new AbortController();
    this.until.addEventListener("abort", () => stop.abort(), { once: true });
    fill(this.state, h("div", { class: "row" }, bdi(file.name), bar, button(texts.ingest.cancel, () => stop.abort())));
    const name = file.name.normalize("NFKD").replace(/[^A-Za-z0-9._-]+/g, "_").replace(/^[^A-Za-z0-9]+/, "").slice(-100) || "recording";
    try {
      const made = await new Promise<{ upload: string }>((done, no) => {
        const request = new XMLHttpRequest();
        request.open("POST", `/v1/uploads?name=${encodeURIComponent(name)}`);
        const secret = token.get();
        if (secret !== null) request.setRequestHeader("Authorization", `Bearer ${secret}`);
        request.setRequestHeader("Content-Type", "application/octet-stream");
        request.responseType = "json";
        request.upload.addEventListener("progress", (event) => event.lengthComputable && (bar.value = event.loaded / event.total));
        request.addEventListener("load", () => (request.status === 201 ? done(request.response as { upload: string }) : no(new ApiError(request.status, (request.response as { detail?: string } | null)?.detail ?? texts.errors.unknown(request.status)))));
        request.addEventListener("error", () => no(new ApiError(0, texts.errors.unreachable)));
        request.addEventListener("abort", () => no(new ApiError(0, texts.ingest.cancelled)));
        stop.signal.addEventListener("abort", () => request.abort());
        request.send(file);
      });
      if (this.recording.value.trim() === "") this.recording.value = file.name.replace(/\.(zip|bag|db3|mcap|db)$/i, "");
      await this.begin({ upload: made.upload });
    } catch (error) {
      if (!this.until.aborted) fill(this.state, failed(error));
    }
  }
}

class Follow {
  private asked = 0;
  private open = new Set<number>();

  constructor(
    private readonly map: string | null,
    private readonly place: HTMLElement,
    private readonly recordings: HTMLElement,
    private readonly until: AbortSignal,
  ) {
    until.addEventListener("abort", () => clearTimeout(this.asked));
  }

  async look(): Promise<void> {
    clearTimeout(this.asked);
    const query = this.map === null ? "" : `&map=${part(this.map)}`;
    try {
      const jobs = (await get<{ items: Job[] }>(`/v1/jobs?limit=50${query}`, this.until)).items;
      if (this.until.aborted) return;
      fill(this.place, jobs.length === 0 ? h("p", { class: "faint" }, texts.ingest.noJobs) : h("ul", { class: "jobs" }, jobs.map((job) => this.job(job))));
      const open = new Set(jobs.filter((job) => OPEN.includes(job.state)).map((job) => job.job));
      if ([...this.open].some((id) => !open.has(id))) void this.lookAtRecordings();
      this.open = open;
      if (open.size > 0) this.asked = window.setTimeout(() => void this.look(), LOOK_MS);
    } catch (error) {
      if (!this.until.aborted) fill(this.place, failed(error, () => void this.look()));
    }
  }

  private job(job: Job): HTMLElement {
    const t = texts.ingest;
    const items = job.items ?? {};
    const total = Object.values(items).reduce((sum, count) => sum + count, 0);
    const progress = job.progress ?? (total > 0 && OPEN.includes(job.state) ? { what: t.keyframesDone, done: items["done"] ?? 0, total } : null);
    const lost = job.recordings.reduce((sum, one) => sum + Object.keys(one.failed ?? {}).length, 0) || (items["failed"] ?? 0);
    return h(
      "li",
      { class: "job" },
      h("div", { class: "row" }, h("span", { class: `tag ${KINDS[job.state] ?? ""}` }, t.states[job.state] ?? job.state), h("strong", null, bdi(job.name)), "→", a(link(["maps", job.map]), null, bdi(job.map)), h("span", { class: "faint" }, moment(job.created_at)), !OPEN.includes(job.state) && (job.state === "failed" || lost > 0) && button(t.retry, () => void this.retry(job.job), { label: t.retryOf(job.name) })),
      progress !== null && h("div", { class: "row" }, h("progress", { attrs: { max: Math.max(progress.total, 1), value: progress.done, "aria-label": progress.what } }), h("span", { class: "faint", attrs: { dir: "auto" } }, `${progress.what} ${progress.done}/${progress.total}`)),
      job.error !== null && h("p", { class: "error-text", attrs: { dir: "auto" } }, job.error),
      lost > 0 && h("p", { class: "error-text" }, t.lost(lost)),
    );
  }

  private async retry(job: number): Promise<void> {
    try {
      await ask(`/v1/jobs/${job}/retry`, { method: "POST", until: this.until });
      await this.look();
    } catch (error) {
      toast(error instanceof Error ? error.message : String(error));
    }
  }

  async lookAtRecordings(): Promise<void> {
    await show(this.recordings, this.until, async () => {
      const t = texts.ingest;
      const query = this.map === null ? "" : `?map=${part(this.map)}`;
      const found = await getAll<Recording>(`/v1/recordings${query}`, this.until, 500);
      if (found.length === 0) return empty(t.noRecordings, [t.noRecordingsHint, command("semdb ingest FOLDER")]);
      const heads = [...(this.map === null ? [t.map] : []), t.name, t.state, t.frames, t.keyframes, t.failed];
      return h(
        "div",
        { class: "table-wrap", attrs: { tabindex: 0, role: "region", "aria-label": t.recordings } },
        h("table", { class: "data" }, h("thead", null, h("tr", null, heads.map((text) => h("th", { attrs: { scope: "col" } }, text)))), h("tbody", null, found.map((one) => this.recording(one)))),
      );
    });
  }

  private recording(one: Recording): HTMLElement {
    const failures = one.items["failed"] ?? 0;
    const cell = h("td", null, failures === 0 ? "0" : button(String(failures), () => void this.failures(one, cell), { label: texts.ingest.showFailures(one.name) }));
    return h("tr", null, this.map === null && h("td", null, a(link(["maps", one.map]), null, bdi(one.map))), h("td", null, bdi(one.name)), h("td", null, texts.ingest.recordingStates[one.state] ?? one.state), h("td", { class: "number" }, one.frame_count), h("td", { class: "number" }, one.keyframes), cell);
  }

  private async failures(one: Recording, cell: HTMLElement): Promise<void> {
    try {
      const found = await getAll<{ frame_index: number; error: string }>(`/v1/maps/${part(one.map)}/recordings/${part(one.name)}/failures`, this.until, Infinity, "failures");
      fill(cell, h("ul", { class: "plain" }, found.map((failure) => h("li", { attrs: { dir: "auto" } }, texts.ingest.failure(failure.frame_index, failure.error)))));
    } catch (error) {
      if (!this.until.aborted) toast(error instanceof Error ? error.message : String(error));
    }
  }
}

function size(bytes: number): string {
  return bytes < 2 ** 20 ? `${(bytes / 1024).toFixed(0)} KiB` : `${(bytes / 2 ** 20).toFixed(1)} MiB`;
}
