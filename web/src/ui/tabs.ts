// The head of a page about a map: its name, and its other pages.
import { link } from "../router";
import { texts } from "../texts";
import { bdi, h } from "./h";
import { a } from "./parts";

const PAGES = ["locate", "queries", "changes", "live", "ingest"] as const;
export type MapPage = (typeof PAGES)[number];

export function mapHead(map: string, current: MapPage): HTMLElement {
  const tab = (address: string, text: string, here: boolean): HTMLElement => {
    const made = a(address, null, text);
    if (here) {
      made.setAttribute("aria-current", "page");
      requestAnimationFrame(() => made.scrollIntoView({ inline: "nearest", block: "nearest" })); // on a phone not all have room
    }
    return made;
  };
  return h(
    "header",
    { class: "map-head" },
    h("h1", null, texts.tabs[current]),
    h("nav", { class: "tabs", attrs: { "aria-label": texts.tabs.label } }, [
      a(link(["maps", map]), { class: "map-name" }, bdi(map)),
      PAGES.map((page) => tab(link(["maps", map, page]), texts.tabs[page], page === current)),
    ]),
  );
}
