// What the service answers, as far as the page reads it (docs/service.md, /v1/openapi.json).

export type Vector3 = [number, number, number];

export interface MapInfo {
  name: string;
  id: number;
  keyframes: number;
  recordings: number;
}

export interface Pose {
  position: Vector3;
  quat_wxyz: [number, number, number, number];
}

export interface KeyframeInfo {
  id: number;
  map: string;
  recording: string;
  frame_index: number;
  timestamp_ns: number | null;
  camera: { width: number; height: number; fx: number; fy: number; cx: number; cy: number; distortion: number[] };
  pose: Pose;
}

export interface RunLengths {
  size: [number, number];
  counts: number[];
}

export interface SeenObject {
  id: number | null;
  category: string;
  score: number;
  box: [number, number, number, number];
  position: Vector3 | null;
  extent: Vector3 | null;
  mask?: RunLengths;
}

export interface KeypointColumns {
  x: number[];
  y: number[];
  size: number[];
  object_index: number[];
  points: (number | null)[][];
}

export interface LandmarkInfo {
  id: number;
  map: string;
  category: string;
  probability: number;
  classes: Record<string, number>;
  position: Vector3;
  covariance: number[][];
  box: { size: Vector3; yaw: number };
  state: string;
  sightings: number;
  keyframes: number;
  missed: number;
  seen_through: number;
  first_seen_ns: number | null;
  last_seen: { recording: string | null; frame_index: number | null; timestamp_ns: number | null };
  relations: Relation[];
}

export interface Relation {
  landmark: number;
  kind: string;
  other_landmark: number;
  score: number;
}

export interface Sighting {
  landmark: number;
  object: number;
  ordinal: number;
  keyframe: number;
  recording: string;
  frame_index: number;
  timestamp_ns: number | null;
  category: string;
  score: number;
  box: [number, number, number, number];
  coverage: number;
  visibility: number;
}

export interface LoggedQuery {
  id: number;
  created_at: string;
  image: string;
  verdict: string;
  pose: Pose | null;
  confidence: number;
  inliers: number;
  stage: string;
  reason: string;
  candidates: { keyframe: number; inliers: number; recording: string; frame_index: number }[];
  timing_ms: Record<string, number>;
}

export interface FoundThings {
  understood: Record<string, { said: string; classes: string[]; how: string; like?: string; cosine?: number }>;
  hits: {
    landmark: number;
    map: string;
    category: string;
    probability: number;
    position: Vector3;
    state: string;
    keyframes: number;
    score: number;
    viewpoint: { keyframe: number; crop: [number, number, number, number] } | null;
  }[];
  missing: {
    reason: string;
    text: string;
    candidates: { landmark?: number; id?: number; category?: string }[];
    usual_places: { kind?: string; relation?: string; category: string; count: number }[];
  } | null;
}
