// What a localization says, for people.
import { texts } from "../texts";
import { h } from "./h";

const KINDS: Record<string, string> = { localized: "good", ambiguous: "warn", coarse: "warn", failed: "bad" };

/** The verdict as a tag. */
export function verdictTag(verdict: string): HTMLElement {
  return h("span", { class: `tag ${KINDS[verdict] ?? ""}`, title: verdictWords(verdict) }, texts.verdicts.names[verdict] ?? verdict);
}

/** The verdict as a sentence. */
export function verdictWords(verdict: string): string {
  return texts.verdicts.words[verdict] ?? verdict;
}

export function metres(value: number): string {
  const size = Math.abs(value);
  if (size < 0.1) return `${(value * 1000).toFixed(size < 0.01 ? 1 : 0)} mm`;
  return size < 10 ? `${value.toFixed(2)} m` : `${value.toFixed(1)} m`;
}

export function place(position: readonly number[] | null): string {
  return position === null ? "–" : position.map((value) => value.toFixed(2)).join(", ");
}

/** A time of the service (UTC) as people of here write it. */
export function moment(text: string): string {
  const time = new Date(text);
  return Number.isNaN(time.getTime()) ? text : time.toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "medium" });
}

/** Standard deviations of a covariance [6, 6] (m, rad): the largest on the diagonal of each half. */
export function sigmas(covariance: number[][] | null): { m: number; deg: number } | null {
  if (covariance === null) return null;
  const at = (k: number): number => Math.sqrt(Math.max(0, covariance[k]?.[k] ?? 0));
  return { m: Math.max(at(0), at(1), at(2)), deg: (Math.max(at(3), at(4), at(5)) * 180) / Math.PI };
}
