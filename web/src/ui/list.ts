// A list of any length of which only what is seen has elements.
import { fill, h } from "./h";

export interface ListOptions<T> {
  /** Height of a row, pixels. */
  rowHeight: number;
  row: (item: T, index: number) => HTMLElement;
  label: string;
  /** Enter, or a click on a row. */
  chosen?: (item: T, index: number) => void;
}

export class VirtualList<T> {
  readonly element: HTMLElement;
  private readonly space: HTMLElement;
  private items: readonly T[] = [];
  private current = -1;
  private first = -1;
  private last = -1;
  private asked = 0;

  constructor(private readonly options: ListOptions<T>) {
    this.space = h("div", { class: "list-space" });
    this.element = h(
      "div",
      {
        class: "list",
        attrs: { role: "listbox", tabindex: 0, "aria-label": options.label },
        on: { keydown: (event) => this.onKey(event), scroll: () => this.later(), click: (event) => this.onClick(event) },
      },
      this.space,
    );
    new ResizeObserver(() => this.later()).observe(this.element);
  }

  set(items: readonly T[]): void {
    this.items = items;
    this.current = Math.min(this.current, items.length - 1);
    this.space.style.height = `${items.length * this.options.rowHeight}px`;
    this.first = -1;
    this.draw();
  }

  /** Marks an item, and brings it into sight. */
  select(index: number, scroll = true): void {
    this.current = index;
    const { rowHeight } = this.options;
    const { scrollTop, clientHeight } = this.element;
    if (scroll && index >= 0) {
      if (index * rowHeight < scrollTop) this.element.scrollTop = index * rowHeight;
      else if ((index + 1) * rowHeight > scrollTop + clientHeight) this.element.scrollTop = (index + 1) * rowHeight - clientHeight;
    }
    this.first = -1;
    this.draw();
  }

  private later(): void {
    cancelAnimationFrame(this.asked);
    this.asked = requestAnimationFrame(() => this.draw());
  }

  private draw(): void {
    const { rowHeight, row } = this.options;
    const { scrollTop, clientHeight } = this.element;
    const first = Math.max(0, Math.floor(scrollTop / rowHeight) - 6);
    const last = Math.min(this.items.length, Math.ceil((scrollTop + clientHeight) / rowHeight) + 6);
    if (first === this.first && last === this.last) return;
    this.first = first;
    this.last = last;
    const rows = this.items.slice(first, last).map((item, offset) => {
      const index = first + offset;
      const made = row(item, index);
      made.classList.add("list-row");
      made.id ||= `${this.options.label.replace(/\W+/g, "-")}-${index}`;
      made.dataset["index"] = String(index);
      made.setAttribute("role", "option");
      made.setAttribute("aria-selected", String(index === this.current));
      made.setAttribute("aria-setsize", String(this.items.length));
      made.setAttribute("aria-posinset", String(index + 1));
      made.style.transform = `translateY(${index * rowHeight}px)`;
      made.style.height = `${rowHeight}px`;
      if (index === this.current) this.element.setAttribute("aria-activedescendant", made.id);
      return made;
    });
    fill(this.space, rows);
  }

  private onClick(event: MouseEvent): void {
    const row = event.target instanceof Element ? event.target.closest<HTMLElement>(".list-row") : null;
    const index = Number(row?.dataset["index"] ?? -1);
    const item = this.items[index];
    if (item === undefined) return;
    this.select(index, false);
    this.options.chosen?.(item, index);
  }

  private onKey(event: KeyboardEvent): void {
    const page = Math.max(1, Math.floor(this.element.clientHeight / this.options.rowHeight) - 1);
    const steps: Record<string, number> = { ArrowDown: 1, ArrowUp: -1, PageDown: page, PageUp: -page, Home: -Infinity, End: Infinity };
    const step = steps[event.key];
    if (step !== undefined && this.items.length > 0) {
      event.preventDefault();
      this.select(Math.max(0, Math.min(this.items.length - 1, this.current + step)));
    } else if (event.key === "Enter") {
      const item = this.items[this.current];
      if (item !== undefined) this.options.chosen?.(item, this.current);
    }
  }
}
