// Statements: the schema at hand, questions to begin with, rows as a table, as CSV, or in the map.
import { ApiError, get, getAll } from "../api";
import { type Context, type Updatable, link, setQuery } from "../router";
import { texts } from "../texts";
import type { MapInfo } from "../types";
import { bdi, fill, h } from "../ui/h";
import { key } from "../ui/keys";
import { a, button, copyLink, empty, failed, loading, save } from "../ui/parts";
import { rowsInMaps } from "./parts/rows";

interface Schema {
  tables: Record<string, string[]>;
  about: Record<string, { kind: string; about: string; columns: Record<string, string> }>;
}

interface Question {
  title: string;
  about: string;
  sql: string;
}

export interface Rows {
  columns: string[];
  rows: unknown[][];
  truncated: boolean;
}

const FIRST = "SELECT map, recording, state, keyframes, objects\nFROM recording_summary\nORDER BY map, recording";
const MOST_SHOWN = 1000;

export function sql({ root, until, query }: Context): Updatable {
  document.title = texts.title(texts.sql.title);
  root.className = "sql";
  const page = new SqlPage(until);
  root.append(page.element);
  const given = query.get("q");
  page.editor.value = given ?? FIRST;
  page.fit();
  if (given) void page.run();
  return {
    update: (_, next) => {
      const text = next.get("q") ?? FIRST;
      if (text !== page.ran) {
        page.editor.value = text;
        page.fit();
        if (next.has("q")) void page.run();
      }
      return true;
    },
  };
}

class SqlPage {
  readonly element: HTMLElement;
  readonly editor = h("textarea", { id: "statement", attrs: { spellcheck: "false", autocapitalize: "off", autocomplete: "off", rows: 6, "aria-label": texts.sql.statement } });
  ran = "";
  private asking = new AbortController();
  private readonly out = h("div", { class: "sql-out", attrs: { "aria-live": "polite" } });

  constructor(private readonly until: AbortSignal) {
    const t = texts.sql;
    const side = h("aside", { class: "sql-side", attrs: { "aria-label": t.schema } }, loading());
    this.element = h(
      "div",
      { class: "sql-view" },
      side,
      h(
        "div",
        { class: "sql-main" },
        h("h1", null, t.title),
        this.editor,
        h("div", { class: "row" }, button(t.run, () => this.submit(), { class: "button primary", title: "Ctrl+Enter" }), h("span", { class: "faint" }, h("kbd", null, "Ctrl"), "+", h("kbd", null, "Enter")), button(t.share, () => this.share())),
        this.out,
      ),
    );
    this.editor.addEventListener("input", () => this.fit());
    this.editor.addEventListener("keydown", (event) => {
      if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) {
        event.preventDefault();
        this.submit();
      }
    });
    key("/", () => this.editor.focus(), until);
    until.addEventListener("abort", () => this.asking.abort());
    void this.fillSide(side);
  }

  fit(): void {
    this.editor.rows = Math.min(18, Math.max(5, this.editor.value.split("\n").length + 1));
  }

  private submit(): void {
    const text = this.editor.value.trim();
    if (text === "") return;
    if (new URLSearchParams(location.search).get("q") === text) void this.run();
    else {
      this.ran = text;
      setQuery({ q: text, show: null }, false);
      void this.run();
    }
  }

  private share(): void {
    setQuery({ q: this.editor.value.trim() });
    void copyLink();
  }

  async run(): Promise<void> {
    this.asking.abort();
    this.asking = new AbortController();
    const now = this.asking.signal;
    const text = this.editor.value.trim();
    this.ran = text;
    const wait = setTimeout(() => fill(this.out, loading(texts.sql.running)), 150);
    const started = performance.now();
    try {
      const found = await get<Rows>(`/v1/sql?${new URLSearchParams({ sql: text })}`, now);
      clearTimeout(wait);
      fill(this.out, this.result(text, found, performance.now() - started));
    } catch (error) {
      clearTimeout(wait);
      if (now.aborted) return;
      const shown = failed(error);
      if (error instanceof ApiError && error.status === 501) shown.append(h("p", null, texts.sql.needsReader));
      fill(this.out, shown);
    }
  }

  private result(text: string, found: Rows, ms: number): HTMLElement {
    const t = texts.sql;
    const shown = found.rows.slice(0, MOST_SHOWN);
    const numeric = found.columns.map((_, k) => shown.every((row) => row[k] === null || typeof row[k] === "number"));
    const table = h(
      "table",
      { class: "data" },
      h("thead", null, h("tr", null, found.columns.map((name, k) => h("th", { class: numeric[k] ? "number" : "", attrs: { scope: "col" } }, bdi(name))))),
      h("tbody", null, shown.map((row) => h("tr", null, row.map((value, k) => h("td", { class: numeric[k] ? "number" : "", ...(value === null ? { attrs: { "aria-label": "null" } } : {}) }, cell(value)))))),
    );
    const map = h("div");
    const canShow = rowsInMaps.can(found);
    const showInMaps = (): void => {
      setQuery({ show: "map" });
      void rowsInMaps.show(map, found, this.until);
    };
    if (canShow && new URLSearchParams(location.search).get("show") === "map") showInMaps();
    return h(
      "div",
      { class: "stack" },
      h(
        "div",
        { class: "row" },
        h("strong", null, texts.count(found.rows.length, t.row, t.rows)),
        h("span", { class: "faint" }, t.took(ms)),
        found.truncated && h("span", { class: "tag warn" }, t.truncated),
        button(t.csv, () => void save(`/v1/sql?${new URLSearchParams({ sql: text, format: "csv" })}`, "rows.csv", this.until)),
        canShow && button(t.inMap, showInMaps),
      ),
      map,
      found.rows.length === 0 ? empty(t.noRows) : h("div", { class: "table-wrap rows", attrs: { tabindex: 0, role: "region", "aria-label": t.result } }, table),
    );
  }

  private async fillSide(side: HTMLElement): Promise<void> {
    const t = texts.sql;
    try {
      const [schema, asked] = await Promise.all([get<Schema>("/v1/tables", this.until), get<{ questions: Question[] }>("/v1/questions", this.until)]);
      const maps = await getAll<MapInfo>("/v1/maps", this.until, 1);
      const filter = h("input", { attrs: { type: "search", placeholder: t.filter, "aria-label": t.filter } });
      const names = Object.keys(schema.tables);
      names.sort((one, other) => Number(schema.about[other]?.kind === "view") - Number(schema.about[one]?.kind === "view") || one.localeCompare(other));
      const tables = names.map((name) => this.table(name, schema));
      filter.addEventListener("input", () => {
        const wanted = filter.value.toLowerCase();
        tables.forEach((element, k) => (element.hidden = !(names[k] ?? "").includes(wanted) && !(schema.tables[names[k] ?? ""] ?? []).some((column) => column.includes(wanted))));
      });
      fill(
        side,
        h("details", { attrs: { open: true } }, h("summary", null, h("h2", null, t.questions)), h("ul", { class: "questions" }, asked.questions.map((one) => this.question(one, maps[0]?.name)))),
        h("details", { attrs: { open: true } }, h("summary", null, h("h2", null, t.schema)), filter, h("div", null, tables)),
      );
    } catch (error) {
      if (!this.until.aborted) fill(side, failed(error, () => void this.fillSide(side)));
    }
  }

  private question(one: Question, map: string | undefined): HTMLElement {
    // the cookbook asks a map called room
    const text = map === undefined ? one.sql : one.sql.replaceAll("'room'", `'${map.replaceAll("'", "''")}'`);
    const act = (): void => {
      this.editor.value = text;
      this.fit();
      this.submit();
    };
    return h("li", null, h("button", { class: "question", title: one.sql, attrs: { type: "button" }, on: { click: act } }, h("span", null, one.title), one.about !== "" && h("small", null, one.about)));
  }

  private table(name: string, schema: Schema): HTMLElement {
    const about = schema.about[name];
    const insert = (text: string) => (): void => {
      this.editor.setRangeText(text, this.editor.selectionStart, this.editor.selectionEnd, "end");
      this.editor.focus();
    };
    return h(
      "details",
      { class: "table" },
      h("summary", null, h("code", null, name), about?.kind === "view" && h("span", { class: "tag" }, texts.sql.view)),
      about && h("p", { class: "faint" }, about.about),
      h("ul", null, (schema.tables[name] ?? []).map((column) => h("li", null, h("button", { class: "column", title: texts.sql.insert(column), attrs: { type: "button" }, on: { click: insert(column) } }, h("code", null, column)), h("span", { class: "faint" }, about?.columns[column] ?? "")))),
      h("p", null, a(link(["sql"], { q: `SELECT * FROM ${name} LIMIT 50` }), null, texts.sql.look)),
    );
  }
}

function cell(value: unknown): Node | string {
  if (value === null) return h("span", { class: "null", attrs: { "aria-hidden": "true" } }, "null");
  if (typeof value === "number") return Number.isInteger(value) ? String(value) : String(Number(value.toPrecision(7)));
  const text = typeof value === "string" ? value : JSON.stringify(value);
  return bdi(text.length > 400 ? `${text.slice(0, 400)}…` : text);
}
