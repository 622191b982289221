// Values that tell who listens when they change.

export type Stop = () => void;

export class Signal<T> {
  private value: T;
  private readonly listeners = new Set<(value: T) => void>();

  constructor(value: T) {
    this.value = value;
  }

  get(): T {
    return this.value;
  }

  set(value: T): void {
    if (Object.is(value, this.value)) return;
    this.value = value;
    for (const listener of [...this.listeners]) listener(value);
  }

  /** Calls `listener` now and at each change, until `until` is aborted. */
  watch(listener: (value: T) => void, until?: AbortSignal): Stop {
    const stop = (): void => void this.listeners.delete(listener);
    if (until?.aborted) return stop;
    this.listeners.add(listener);
    until?.addEventListener("abort", stop, { once: true });
    listener(this.value);
    return stop;
  }
}
