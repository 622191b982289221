// Builds the page into semdb/service/page (or the folder given): the same bytes from the same sources, wherever it runs.
import { build } from "esbuild";
import { copyFile, mkdir, readFile, readdir, rm, writeFile } from "node:fs/promises";
import { basename, dirname, join, resolve } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
const out = resolve(process.argv[2] ?? join(here, "..", "semdb", "service", "page"));

await mkdir(out, { recursive: true });
for (const name of await readdir(out)) {
  if (name !== "__init__.py") await rm(join(out, name), { recursive: true });
}
const { metafile } = await build({
  absWorkingDir: here,
  entryPoints: { main: "src/main.ts", style: "src/styles/all.css" },
  outdir: out,
  bundle: true,
  splitting: true,
  format: "esm",
  target: "es2022",
  minify: true,
  legalComments: "none",
  charset: "utf8",
  chunkNames: "chunk-[hash]",
  logLevel: "warning",
  metafile: true,
});
// what is needed for the first picture is asked for at once, not file by file as each names the next
const outputs = Object.entries(metafile.outputs).map(([path, made]) => ({ ...made, name: basename(path) }));
const needed = new Set();
function need(name) {
  if (needed.has(name)) return;
  needed.add(name);
  for (const { path, kind } of outputs.find((made) => made.name === name).imports) if (kind === "import-statement") need(basename(path));
}
need("main.js");
for (const { entryPoint, name } of outputs) if (entryPoint === "src/views/maps.ts") need(name);
needed.delete("main.js");
const early = [...needed].sort().map((name) => `    <link rel="modulepreload" href="/page/BUILD/${name}" />\n`).join("");
const page = await readFile(join(here, "src", "index.html"), "utf8");
await writeFile(join(out, "index.html"), page.replace("    <!-- early -->\n", early));
await copyFile(join(here, "src", "icon.svg"), join(out, "icon.svg"));
await copyFile(join(here, "node_modules", "three", "LICENSE"), join(out, "three.LICENSE"));
