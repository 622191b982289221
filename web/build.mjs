// Builds the page into semdb/service/page (or the folder given): the same bytes from the same sources, wherever it runs.
import { build } from "esbuild";
import { copyFile, mkdir, readdir, rm } from "node:fs/promises";
import { dirname, join, resolve } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
const out = resolve(process.argv[2] ?? join(here, "..", "semdb", "service", "page"));

await mkdir(out, { recursive: true });
for (const name of await readdir(out)) {
  if (name !== "__init__.py") await rm(join(out, name), { recursive: true });
}
await build({
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
});
for (const name of ["index.html", "icon.svg"]) await copyFile(join(here, "src", name), join(out, name));
await copyFile(join(here, "node_modules", "three", "LICENSE"), join(out, "three.LICENSE"));
