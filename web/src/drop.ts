// Photos and folders that are dropped anywhere on the page, or chosen: they go to where they are localized.
import { Signal } from "./ui/signal";
import { go, link } from "./router";
import { texts } from "./texts";
import { h } from "./ui/h";
import { toast } from "./ui/parts";

/** A photo to localize; of a folder with masks also whose each pixel is. */
export interface Photo {
  name: string;
  file: File;
  instances?: File;
}

export interface Dropped {
  photos: Photo[];
  /** Classes of the labels in `instances`, JSON. */
  categories: string | null;
  /** Of camera.json in a recording's folder: fx,fy,cx,cy and distortion. */
  camera: string | null;
}

/** What was dropped last and nobody has taken yet. */
export const dropped = new Signal<Dropped | null>(null);

const PICTURE = /\.(png|jpe?g)$/i;
const MOST = 500;

interface Found {
  path: string;
  file: File;
}

/** Photos among files: of a recording's folder those of colour, with their masks where it has some. */
export async function photosOf(files: readonly Found[]): Promise<Dropped> {
  const pictures = files.filter(({ path }) => PICTURE.test(path));
  const folderOf = (path: string): string => path.split("/").at(-2) ?? "";
  const stem = (path: string): string => (path.split("/").at(-1) ?? "").replace(/\.[^.]*$/, "");
  const masks = new Map(pictures.filter(({ path }) => folderOf(path) === "masks").map(({ path, file }) => [stem(path), file]));
  const plain = pictures.filter(({ path }) => !["masks", "depth"].includes(folderOf(path)) && !/\.(depth|mask)\.[a-z]+$/i.test(path));
  plain.sort((one, other) => one.path.localeCompare(other.path, "en", { numeric: true }));
  const classes = files.find(({ path }) => folderOf(path) === "masks" && path.endsWith("/classes.json"));
  const categories = classes ? await classes.file.text() : null;
  const own = files.find(({ path }) => path.endsWith("/camera.json"));
  const camera = own ? cameraText(await own.file.text()) : null;
  const photos = plain.slice(0, MOST).map(({ path, file }): Photo => {
    const instances = categories === null ? undefined : masks.get(stem(path));
    return { name: path, file, ...(instances ? { instances } : {}) };
  });
  if (plain.length > MOST) toast(texts.drop.most(MOST, plain.length));
  return { photos, categories, camera };
}

function cameraText(json: string): string | null {
  try {
    const found = JSON.parse(json) as Record<string, unknown>;
    const more = Array.isArray(found["distortion"]) ? (found["distortion"] as unknown[]) : [];
    const numbers = [...["fx", "fy", "cx", "cy"].map((name) => found[name]), ...more];
    return numbers.every((value) => typeof value === "number") ? numbers.join(",") : null;
  } catch {
    return null;
  }
}

async function filesIn(entry: FileSystemEntry, above = ""): Promise<Found[]> {
  const path = above ? `${above}/${entry.name}` : entry.name;
  if (entry.isFile) {
    const file = await new Promise<File>((done, no) => (entry as FileSystemFileEntry).file(done, no));
    return [{ path, file }];
  }
  const reader = (entry as FileSystemDirectoryEntry).createReader();
  const found: Found[] = [];
  for (;;) {
    const some = await new Promise<FileSystemEntry[]>((done, no) => reader.readEntries(done, no));
    if (some.length === 0) return found;
    for (const one of some) found.push(...(await filesIn(one, path)));
  }
}

async function filesOf(data: DataTransfer): Promise<Found[]> {
  const entries = [...data.items].map((item) => item.webkitGetAsEntry()).filter((entry): entry is FileSystemEntry => entry !== null);
  if (entries.length > 0) return (await Promise.all(entries.map((entry) => filesIn(entry)))).flat();
  return [...data.files].map((file) => ({ path: file.webkitRelativePath || file.name, file }));
}

/** Files of an <input>. */
export function chosenFiles(list: FileList): Promise<Dropped> {
  return photosOf([...list].map((file) => ({ path: file.webkitRelativePath || file.name, file })));
}

/** The map that an address is about. */
function mapOfAddress(): string | null {
  const parts = location.pathname.split("/").filter(Boolean);
  return parts[0] === "maps" && parts[1] ? decodeURIComponent(parts[1]) : null;
}

/** Takes what is dropped, unless an element with data-drops takes it itself. */
export function takeDrops(): void {
  const veil = h("div", { class: "veil", attrs: { hidden: true, "aria-hidden": "true" } }, h("strong", null, texts.drop.here), h("span", null, texts.drop.hint));
  document.body.append(veil);
  const own = (event: DragEvent): boolean => event.target instanceof Element && event.target.closest("[data-drops]") !== null;
  const hasFiles = (event: DragEvent): boolean => event.dataTransfer?.types.includes("Files") ?? false;
  let inside = 0;
  addEventListener("dragenter", (event) => {
    if (!hasFiles(event)) return;
    inside += 1;
    veil.hidden = own(event);
  });
  addEventListener("dragleave", () => {
    inside = Math.max(0, inside - 1);
    if (inside === 0) veil.hidden = true;
  });
  addEventListener("dragover", (event) => hasFiles(event) && event.preventDefault());
  addEventListener("drop", (event) => {
    inside = 0;
    veil.hidden = true;
    if (!hasFiles(event) || !event.dataTransfer || own(event)) return;
    event.preventDefault();
    void filesOf(event.dataTransfer)
      .then(photosOf)
      .then((found) => {
        if (found.photos.length === 0) {
          toast(texts.drop.nothing);
          return;
        }
        dropped.set(found);
        const map = mapOfAddress();
        go(map === null ? link(["locate"]) : link(["maps", map, "locate"]));
      });
  });
}
