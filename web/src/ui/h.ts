// Elements without a framework. Text from anywhere becomes a text node, never markup.

export type Child = Node | string | number | null | undefined | false | readonly Child[];

type Handlers = { [K in keyof HTMLElementEventMap]?: (event: HTMLElementEventMap[K]) => void };

export interface Props {
  class?: string | undefined;
  id?: string;
  title?: string | undefined;
  /** Attributes as they are written in HTML; false, null and undefined leave one out, true is an empty one. */
  attrs?: Record<string, string | number | boolean | null | undefined>;
  on?: Handlers;
  /** Called with the new element. */
  ref?: (element: HTMLElement) => void;
}

type TagName = keyof HTMLElementTagNameMap;

export function h<K extends TagName>(tag: K, props?: Props | null, ...children: Child[]): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  if (props) {
    if (props.class) element.className = props.class;
    if (props.id) element.id = props.id;
    if (props.title) element.title = props.title;
    for (const [name, value] of Object.entries(props.attrs ?? {})) attribute(element, name, value);
    for (const [name, handler] of Object.entries(props.on ?? {})) {
      element.addEventListener(name, handler as EventListener);
    }
  }
  append(element, children);
  props?.ref?.(element);
  return element;
}

export function attribute(element: Element, name: string, value: string | number | boolean | null | undefined): void {
  if (value === false || value === null || value === undefined) element.removeAttribute(name);
  else element.setAttribute(name, value === true ? "" : String(value));
}

export function append(parent: Node, children: readonly Child[]): void {
  for (const child of children) {
    if (child === null || child === undefined || child === false) continue;
    if (Array.isArray(child)) append(parent, child as readonly Child[]);
    else if (child instanceof Node) parent.appendChild(child);
    else parent.appendChild(document.createTextNode(String(child)));
  }
}

/** Replaces all that is inside of `parent`. */
export function fill(parent: Element, ...children: Child[]): void {
  parent.replaceChildren();
  append(parent, children);
}

/** A name or text from the database: shown as it is, in its own direction. */
export function bdi(text: string | number): HTMLElement {
  const element = document.createElement("bdi");
  element.textContent = String(text);
  return element;
}

const SVG = "http://www.w3.org/2000/svg";

/** An element of SVG. */
export function svg(
  tag: string,
  attrs: Record<string, string | number> = {},
  ...children: (Node | string)[]
): SVGElement {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attrs)) element.setAttribute(name, String(value));
  for (const child of children) element.append(child);
  return element;
}
