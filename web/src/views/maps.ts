// All maps, as cards.
import { get, getAll, load, part } from "../api";
import { type Context, link } from "../router";
import { texts } from "../texts";
import type { KeyframeInfo, MapInfo } from "../types";
import { bdi, h } from "../ui/h";
import { a, command, empty, show } from "../ui/parts";

export function maps({ root, until }: Context): void {
  document.title = texts.title(texts.maps.title);
  root.className = "page";
  const place = h("div");
  root.append(h("h1", null, texts.maps.title), place);
  void show(place, until, async () => {
    const found = await getAll<MapInfo>("/v1/maps", until);
    if (found.length === 0) return empty(texts.maps.none, [texts.maps.noneHint, command(texts.maps.noneCommand)]);
    return h("ul", { class: "cards" }, found.map((info) => card(info, until)));
  });
}

function card(info: MapInfo, until: AbortSignal): HTMLElement {
  const counts = [
    texts.count(info.keyframes, texts.maps.keyframe, texts.maps.keyframes),
    texts.count(info.recordings, texts.maps.recording, texts.maps.recordings),
  ].join(" · ");
  const pictures = h("div", { class: `card-picture${info.keyframes === 0 ? " none" : ""}`, attrs: { "aria-hidden": "true" } });
  if (info.keyframes > 0) void mosaic(info, pictures, until);
  return h(
    "li",
    { class: "card" },
    a(link(["maps", info.name]), null, pictures, h("div", { class: "card-text" }, h("h2", null, bdi(info.name)), h("p", { class: "faint" }, info.keyframes > 0 ? counts : texts.maps.emptyMap))),
  );
}

/** A large picture and two small ones, of keyframes that lie apart. */
async function mosaic(info: MapInfo, place: HTMLElement, until: AbortSignal): Promise<void> {
  try {
    const found = await get<{ items: KeyframeInfo[] }>(`/v1/maps/${part(info.name)}/keyframes?limit=60`, until);
    const { items } = found;
    const chosen = [0.15, 0.85].map((share) => items[Math.floor(share * items.length)]).filter((item) => item !== undefined);
    const addresses = [...new Set(chosen)].map((item) => `/v1/keyframes/${item.id}/image?width=320`);
    for (const address of [`/v1/maps/${part(info.name)}/picture?width=480`, ...addresses]) {
      const image = h("img", { attrs: { alt: "", loading: "lazy" } });
      load(image, address, until);
      place.append(image);
    }
  } catch {
    place.classList.add("none");
  }
}
