// What is around every view: skip link, header, keys, help.
import { go } from "./router";
import { texts } from "./texts";
import { h, svg } from "./ui/h";
import { key } from "./ui/keys";
import { a, button, dialog } from "./ui/parts";
import { toggleTheme } from "./ui/theme";
import { askForToken } from "./ui/token";

/** Pages of the head of the page: address, text, key after g. */
export const PAGES: readonly [string, string, string][] = [
  ["/maps", texts.nav.maps, "m"],
  ["/locate", texts.nav.locate, "p"],
  ["/sql", texts.nav.sql, "s"],
  ["/jobs", texts.nav.ingest, "i"],
];

/** Builds it, and gives the element for views. */
export function shell(): HTMLElement {
  const main = h("main", { id: "main", attrs: { tabindex: -1 } });
  const links = PAGES.map(([address, text]) => a(address, null, text));
  document.getElementById("before")?.remove(); // what was there before there was a page
  document.body.append(
    h("a", { class: "skip", attrs: { href: "#main" }, on: { click: () => main.focus() } }, texts.skip),
    h(
      "header",
      { class: "top" },
      a("/maps", { class: "brand" }, h("span", { class: "logo", attrs: { "aria-hidden": "true" } }), texts.product),
      h("nav", { attrs: { "aria-label": texts.nav.label } }, links),
      h("div", { id: "tools", class: "tools" }),
      button("◐", toggleTheme, { class: "icon", label: texts.nav.theme, title: `${texts.nav.theme} (t)` }),
      button(keySign(), () => askForToken(null), { class: "icon", label: texts.nav.token, title: texts.nav.token }),
      button("?", help, { class: "icon", label: texts.nav.help, title: `${texts.nav.help} (?)` }),
    ),
    main,
    h("div", { id: "toasts", attrs: { "aria-live": "polite", role: "status" } }),
  );
  const mark = (): void => {
    for (const link of links) {
      const here = location.pathname === link.pathname || location.pathname.startsWith(`${link.pathname}/`);
      if (here) link.setAttribute("aria-current", "page");
      else link.removeAttribute("aria-current");
    }
  };
  addEventListener("semdb:address", mark);
  addEventListener("popstate", mark);
  mark();
  key("?", help);
  key("t", toggleTheme);
  for (const [address, , letter] of PAGES) key(`g ${letter}`, () => go(address));
  return main;
}

function keySign(): SVGElement {
  const sign = svg("svg", { viewBox: "0 0 20 20", width: 18, height: 18, "aria-hidden": "true" });
  sign.append(svg("path", { d: "M12.5 3a4.500 4.500 0 1 1-3.900 6.750L3 15.300V17h3v-2h2v-2h1.500l1.600-1.600M13.500 6.500h.01", fill: "none", stroke: "currentColor", "stroke-width": 1.6, "stroke-linecap": "round", "stroke-linejoin": "round" }));
  return sign;
}

let helping: HTMLDialogElement | null = null;

function help(): void {
  if (helping) return;
  const rows = texts.help.keys.map(([name, text]) => [h("dt", null, h("kbd", null, name)), h("dd", null, text)]);
  helping = dialog(texts.help.title, h("dl", { class: "keys" }, rows), () => (helping = null));
}
