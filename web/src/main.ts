import { token, tokenNeeded } from "./api";
import { takeDrops } from "./drop";
import { type Updatable, go, match } from "./router";
import { routes } from "./routes";
import { shell } from "./shell";
import { texts } from "./texts";
import { fill, h } from "./ui/h";
import { listenToKeys } from "./ui/keys";
import { a, failed, followLinks } from "./ui/parts";
import { followTheme } from "./ui/theme";
import { askForToken } from "./ui/token";

followTheme();
listenToKeys();
followLinks();
takeDrops();
const main = shell();

let ending = new AbortController();
let shown: { route: unknown; view: Updatable | null } = { route: null, view: null };

async function navigate(anew = false): Promise<void> {
  const found = match(routes, location.pathname);
  const query = new URLSearchParams(location.search);
  if (!anew && found && shown.route === found.route && shown.view?.update(found.params, query)) return;
  ending.abort();
  ending = new AbortController();
  const until = ending.signal;
  const focused = shown.route !== null;
  shown = { route: found?.route ?? "nowhere", view: null };
  main.className = "";
  document.title = texts.title(texts.product);
  fill(main);
  if (!found) {
    document.title = texts.title(texts.errors.notFound);
    main.className = "page";
    fill(main, h("h1", null, texts.errors.notFound), h("p", null, texts.errors.notFoundHint), h("p", null, a("/maps", null, texts.errors.toMaps)));
    return;
  }
  try {
    const view = await found.route.load();
    if (until.aborted) return;
    const made = await view({ params: found.params, query, until, root: main });
    if (!until.aborted) shown.view = made ?? null;
  } catch (error) {
    if (until.aborted) return;
    fill(main, failed(error, () => void navigate(true)));
  }
  // a new page is read from its beginning, also by screen readers
  if (focused && !until.aborted && (document.activeElement === document.body || document.activeElement === null)) main.focus();
}

addEventListener("popstate", () => void navigate());
addEventListener("semdb:address", () => void navigate());
tokenNeeded.watch((detail) => detail !== null && askForToken(detail));
let before = token.get();
token.watch((value) => {
  if (value === before) return;
  before = value;
  void navigate(true);
});
if (location.pathname === "/") go("/maps", true);
else void navigate();
