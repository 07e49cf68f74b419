/* Columns of 64-bit integers, and what is computed of them. Times are nanoseconds. */
"use strict";
var mp4dsColumns = (() => {
  const bytesOf = text => {
    const raw = atob(text), bytes = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
    return bytes;
  };

  /** A column as written by mp4ds.plugins.reporting.cameras.pack_column: a BigInt64Array of `count` values. */
  function decode(packed, count) {
    const Kind = {1: Int8Array, 2: Int16Array, 4: Int32Array, 8: BigInt64Array}[packed.size];
    const residuals = new Kind(bytesOf(packed.values).buffer), step = BigInt(packed.step);
    if (residuals.length !== count - 1) throw new Error("a column has the wrong length");
    const out = new BigInt64Array(count);
    out[0] = BigInt(packed.start);
    for (let i = 1; i < count; i++) out[i] = out[i - 1] + step + BigInt(residuals[i - 1]);  // modulo 2^64
    return out;
  }

  const decodeFloats = text => {
    const bytes = bytesOf(text), view = new DataView(bytes.buffer);
    return Float64Array.from({length: bytes.length / 4}, (_, i) => view.getFloat32(4 * i, true));
  };

  /** Index of the last entry not above `value`, or -1; values must increase. */
  function lastAtMost(values, value) {
    let low = 0, high = values.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (values[middle] <= value) low = middle + 1; else high = middle;
    }
    return low - 1;
  }

  /** Milliseconds from the previous frame to each; entry 0 has none and is NaN. */
  function intervals(stamps) {
    const out = new Float64Array(stamps.length).fill(NaN);
    for (let i = 1; i < stamps.length; i++) out[i] = Number(stamps[i] - stamps[i - 1]) / 1e6;
    return out;
  }

  /** The number up to which a share of sorted ones is, between two if need be; NaN of none. */
  function quantile(sorted, share) {
    const at = share * (sorted.length - 1), low = Math.floor(at);
    return sorted.length ? sorted[low] + (sorted[Math.ceil(at)] - sorted[low]) * (at - low) : NaN;
  }

  /** Figures of intervals, entry 0 being none; those that too few frames have are null. */
  function timing(intervals) {
    const steps = intervals.subarray(1), advancing = steps.filter(step => step > 0).sort();
    const median = advancing.length ? quantile(advancing, 0.5) : null, missing = lost(intervals, median);
    let sum = 0, squares = 0;
    for (const step of steps) sum += step;
    for (const step of steps) squares += (step - sum / steps.length) ** 2;
    const count = test => steps.reduce((found, step, i) => found + test(step, missing[i + 1]), 0);
    return {
      median, lost: missing,
      rate: median && 1000 / median,
      jitter: steps.length ? Math.sqrt(squares / steps.length) : null,
      within: median && quantile(steps.map(step => Math.abs(step - median)).sort(), 0.99),
      longest: steps.length ? steps.reduce((most, step) => Math.max(most, step)) : null,
      missing: missing.reduce((found, frames) => found + Math.max(0, frames), 0),
      gaps: count((_, frames) => frames > 0), repeated: count(step => step === 0), backward: count(step => step < 0),
    };
  }

  /** Frames lost before each frame (above 0), by the rule of `lost_frames` in times.py; repeated or earlier stamps are -1. */
  function lost(steps, usual) {
    const out = new Float64Array(steps.length);
    const short = i => i > 0 && i < steps.length ? Math.min(Math.max(usual - steps[i], 0), usual) : 0;
    for (let i = 1; i < steps.length; i++) {
      const spread = steps[i] - short(i - 1) - short(i + 1);
      if (steps[i] <= 0) out[i] = -1;
      else if (usual && spread > 1.5 * usual) out[i] = Math.round(spread / usual) - 1;
    }
    return out;
  }

  const delays = (logTimes, stamps) =>
    Float64Array.from(stamps, (stamp, i) => Number(logTimes[i] - stamp) / 1e6);

  /** How much later each frame is than the nearest reference frame, milliseconds. */
  function offsets(stamps, reference) {
    const ordered = BigInt64Array.from(reference).sort(), out = new Float64Array(stamps.length);
    for (let i = 0, at = 0; i < stamps.length; i++) {
      const stamp = stamps[i];
      if (at && ordered[at - 1] >= stamp) at = lastAtMost(ordered, stamp - 1n) + 1;
      while (at < ordered.length - 1 && ordered[at] < stamp) at++;
      const after = Number(stamp - ordered[at]);
      const before = at ? Number(stamp - ordered[at - 1]) : Infinity;
      out[i] = (Math.abs(before) <= Math.abs(after) ? before : after) / 1e6;
    }
    return out;
  }

  /** Positions of frames on the common axis: nanoseconds from its start, never decreasing. */
  function positions(times, base) {
    const out = new Float64Array(times.length);
    let latest = -Infinity;
    for (let i = 0; i < times.length; i++) {
      latest = Math.max(latest, Number(times[i] - base));
      out[i] = latest;
    }
    return out;
  }

  return {decode, decodeFloats, lastAtMost, intervals, quantile, timing, delays, offsets, positions};
})();
