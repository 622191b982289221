// Dark or light: as the system has it, until someone says otherwise.
import { Signal } from "./signal";

export type Theme = "dark" | "light";

const KEY = "semdb.theme";
const system = matchMedia("(prefers-color-scheme: dark)");

function chosen(): Theme {
  const said = localStorage.getItem(KEY);
  if (said === "dark" || said === "light") return said;
  return system.matches ? "dark" : "light";
}

export const theme = new Signal<Theme>(chosen());

export function followTheme(): void {
  system.addEventListener("change", () => theme.set(chosen()));
  theme.watch((value) => (document.documentElement.dataset["theme"] = value));
}

export function toggleTheme(): void {
  const next = theme.get() === "dark" ? "light" : "dark";
  localStorage.setItem(KEY, next);
  theme.set(next);
}

/** A colour of the style sheet, as "--name" has it now. */
export function colour(name: string): string {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}
