// The token of this tab.
import { token, tokenNeeded } from "../api";
import { texts } from "../texts";
import { h } from "./h";
import { button, command, dialog } from "./parts";

let open: HTMLDialogElement | null = null;

/** Asks for a token; `detail` is what the service said. */
export function askForToken(detail: string | null): void {
  if (open) return;
  const input = h("input", { attrs: { type: "password", name: "token", autocomplete: "off", required: true, spellcheck: "false" } });
  const form = h(
    "form",
    {
      class: "stack",
      on: {
        submit: (event) => {
          event.preventDefault();
          const given = input.value.trim();
          if (given === "") return;
          open?.close();
          token.set(given);
        },
      },
    },
    detail !== null && h("p", { attrs: { dir: "auto" } }, texts.token.refused(detail)),
    h("p", null, texts.token.text, command(texts.token.command)),
    h("label", null, texts.token.label, input),
    h("p", { class: "faint" }, texts.token.kept),
    h(
      "div",
      { class: "row end" },
      token.get() !== null && button(texts.token.forget, () => {
        open?.close();
        token.set(null);
      }),
      h("button", { class: "button primary", attrs: { type: "submit" } }, texts.token.enter),
    ),
  );
  open = dialog(texts.token.title, form, () => {
    open = null;
    tokenNeeded.set(null);
  });
  input.focus();
}
