// Keys of the page. None is taken while someone writes, or with Ctrl, Alt or Meta.

type Handler = () => void;

const bound = new Map<string, Handler[]>();
let prefix = "";
let prefixEnds = 0;

export function isWriting(target: EventTarget | null): boolean {
  return target instanceof HTMLElement && (target.isContentEditable || /^(INPUT|TEXTAREA|SELECT)$/.test(target.tagName));
}

/** Binds a key ("?", "Escape") or a sequence ("g m") until `until` is aborted; the last one bound wins. */
export function key(name: string, handler: Handler, until?: AbortSignal): void {
  const list = bound.get(name) ?? [];
  bound.set(name, list);
  list.push(handler);
  until?.addEventListener("abort", () => list.splice(list.indexOf(handler), 1), { once: true });
}

export function listenToKeys(): void {
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || event.defaultPrevented) return;
    if (isWriting(event.target) && event.key !== "Escape") return;
    const sequence = prefix && event.timeStamp < prefixEnds ? `${prefix} ${event.key}` : event.key;
    prefix = "";
    const handler = bound.get(sequence)?.at(-1);
    if (handler) {
      event.preventDefault();
      handler();
    } else if ([...bound.keys()].some((name) => name.startsWith(`${event.key} `))) {
      prefix = event.key;
      prefixEnds = event.timeStamp + 1200;
    }
  });
}
