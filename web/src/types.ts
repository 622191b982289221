// What the service answers, as far as the page reads it (docs/service.md, /v1/openapi.json).

export type Vector3 = [number, number, number];

export interface MapInfo {
  name: string;
  id: number;
  keyframes: number;
  recordings: number;
}
