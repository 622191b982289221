// The views, each in a file that is loaded when it is first looked at.
import type { Route } from "./router";

export const routes: readonly Route[] = [
  { path: [], load: async () => (await import("./views/maps")).maps },
  { path: ["maps"], load: async () => (await import("./views/maps")).maps },
];
