// What all views are made of.
import { ApiError, ask, isAbort } from "../api";
import { go } from "../router";
import { texts } from "../texts";
import { type Child, fill, h } from "./h";

/** A link within the page. */
export function a(address: string, props: { class?: string; title?: string } | null, ...children: Child[]): HTMLAnchorElement {
  return h("a", { ...props, attrs: { href: address } }, ...children);
}

export function button(label: Child, act: () => void, props: { class?: string; title?: string; label?: string } = {}): HTMLButtonElement {
  const attrs = { type: "button", "aria-label": props.label ?? null };
  return h("button", { class: props.class ?? "button", title: props.title, attrs, on: { click: act } }, label);
}

export function loading(text: string = texts.loading): HTMLElement {
  return h("div", { class: "state", attrs: { role: "status" } }, h("span", { class: "spinner" }), text);
}

/** Nothing is there, and what to do. */
export function empty(title: Child, ...hints: Child[]): HTMLElement {
  return h("div", { class: "state empty" }, h("strong", null, title), hints.map((hint) => h("p", null, hint)));
}

export function command(text: string): HTMLElement {
  return h("code", { class: "command", attrs: { tabindex: 0 } }, text);
}

/** An error in words, with a button that tries again. */
export function failed(error: unknown, again?: () => void): HTMLElement {
  const told = error instanceof Error ? error.message : String(error);
  const id = error instanceof ApiError ? error.requestId : null;
  return h(
    "div",
    { class: "state failed", attrs: { role: "alert" } },
    h("strong", null, texts.errors.title),
    h("p", { attrs: { dir: "auto" } }, told),
    id !== null && h("p", { class: "faint" }, texts.errors.request(id)),
    again && button(texts.retry, again),
  );
}

/** Puts into `place` what `make` gives; meanwhile says that it loads, and says what failed. */
export async function show(place: HTMLElement, until: AbortSignal, make: () => Promise<Child>): Promise<void> {
  const wait = setTimeout(() => fill(place, loading()), 150);
  try {
    const made = await make();
    if (!until.aborted) fill(place, made);
  } catch (error) {
    if (until.aborted || isAbort(error)) return;
    fill(place, failed(error, () => void show(place, until, make)));
  } finally {
    clearTimeout(wait);
  }
}

/** A modal dialog. It closes itself by Esc; `closed` is called then. */
export function dialog(title: string, content: Child, closed?: () => void): HTMLDialogElement {
  const made = h(
    "dialog",
    { class: "dialog", attrs: { "aria-label": title } },
    h("header", null, h("h2", null, title), button("×", () => made.close(), { class: "icon", label: texts.close })),
    h("div", { class: "dialog-body" }, content),
  );
  made.addEventListener("close", () => {
    made.remove();
    closed?.();
  });
  made.addEventListener("click", (event) => event.target === made && made.close());
  document.body.append(made);
  made.showModal();
  return made;
}

/** Says something in passing; screen readers hear it, too. */
export function toast(text: string): void {
  const place = document.getElementById("toasts");
  if (!place) return;
  const made = h("div", { class: "toast", attrs: { dir: "auto" } }, text);
  place.append(made);
  setTimeout(() => made.remove(), 6000);
}

/** Copies the address of what is shown. */
export async function copyLink(): Promise<void> {
  try {
    await navigator.clipboard.writeText(location.href); // there is no clipboard over plain HTTP
    toast(texts.copied);
  } catch {
    toast(texts.copyByHand);
  }
}

/** Saves what the API answers as a file; a plain link would send no token. */
export async function save(address: string, name: string, until: AbortSignal): Promise<void> {
  try {
    const answer = await ask(address, { until });
    const url = URL.createObjectURL(await answer.blob());
    h("a", { attrs: { href: url, download: name } }).click();
    setTimeout(() => URL.revokeObjectURL(url), 1000);
  } catch (error) {
    if (!isAbort(error)) toast(error instanceof Error ? error.message : String(error));
  }
}

/** Links of the page are followed without loading it anew. */
export function followLinks(): void {
  addEventListener("click", (event) => {
    if (event.defaultPrevented || event.button !== 0 || event.ctrlKey || event.metaKey || event.shiftKey || event.altKey) return;
    const link = event.target instanceof Element ? event.target.closest("a[href]") : null;
    if (!(link instanceof HTMLAnchorElement) || link.origin !== location.origin || link.target || link.hasAttribute("download")) return;
    if (link.getAttribute("href")?.startsWith("#") || /^\/(v1|health|ready|metrics|page)\b/.test(link.pathname)) return;
    event.preventDefault();
    go(link.pathname + link.search);
  });
}
