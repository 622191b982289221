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
];
