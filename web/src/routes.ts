// The views, each in a file that is loaded when it is first looked at.
import type { Route } from "./router";

export const routes: readonly Route[] = [
  { path: ["maps"], also: [[]], load: async () => (await import("./views/maps")).maps },
  {
    path: ["maps", ":map"],
    also: [
      ["maps", ":map", "keyframes", ":keyframe"],
      ["maps", ":map", "landmarks", ":landmark"],
    ],
    load: async () => (await import("./views/map")).map,
  },
  { path: ["maps", ":map", "queries"], load: async () => (await import("./views/queries")).queries },
  { path: ["maps", ":map", "queries", ":query"], load: async () => (await import("./views/queries")).query },
  { path: ["maps", ":map", "locate"], load: async () => (await import("./views/locate")).locate },
  { path: ["locate"], load: async () => (await import("./views/locate")).locateAnywhere },
  { path: ["maps", ":map", "changes"], load: async () => (await import("./views/changes")).changes },
  { path: ["maps", ":map", "live"], load: async () => (await import("./views/live")).live },
  { path: ["maps", ":map", "ingest"], load: async () => (await import("./views/ingest")).ingest },
  { path: ["jobs"], load: async () => (await import("./views/ingest")).ingest },
  { path: ["sql"], load: async () => (await import("./views/sql")).sql },
];
