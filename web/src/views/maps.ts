// All maps, as cards.
import { getAll } from "../api";
import { type Context, link } from "../router";
import { texts } from "../texts";
import type { MapInfo } from "../types";
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
    return h("ul", { class: "cards" }, found.map(card));
  });
}

function card(info: MapInfo): HTMLElement {
  const counts = [
    texts.count(info.keyframes, texts.maps.keyframe, texts.maps.keyframes),
    texts.count(info.recordings, texts.maps.recording, texts.maps.recordings),
  ].join(" · ");
  return h("li", { class: "card" }, a(link(["maps", info.name]), null, h("h2", null, bdi(info.name)), h("p", { class: "faint" }, counts)));
}
