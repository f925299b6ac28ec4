// Numbers, durations and shares as texts.

/** Return a number with few digits: 0.123, 12.3, 1,234, 123k, 1.2M. */
export function number(value, digits = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "-";
  const size = Math.abs(value);
  if (size >= 1e6) return `${trimmed(value / 10 ** (size >= 1e9 ? 9 : 6), 3)}${size >= 1e9 ? "G" : "M"}`;
  if (size >= 1e5) return `${trimmed(value / 1000, 3)}k`;
  if (size >= 1000) return Math.round(value).toLocaleString("en");
  if (size > 0 && size < 0.001) return value.toExponential(1);
  return trimmed(value, digits);
}

function trimmed(value, digits) {
  return String(Number(value.toPrecision(digits)));
}

/** Return a whole number with separators. */
export function whole(value) {
  return value === null || value === undefined ? "-" : Math.round(value).toLocaleString("en");
}

/** Return a duration in seconds as 45 s, 12 min or 3.5 h. */
export function duration(seconds) {
  if (seconds === null || seconds === undefined || !Number.isFinite(seconds)) return "-";
  if (seconds < 100) return `${Math.round(Math.max(seconds, 0))} s`;
  if (seconds < 6000) return `${Math.round(seconds / 60)} min`;
  return `${(seconds / 3600).toFixed(1)} h`;
}

/** Return a share in whole percent that is 0 or 100 only of none or all, such as a win rate of 0.996. */
export function percent(share) {
  if (share > 0 && share < 0.005) return "<1 %";
  if (share >= 0.995 && share < 1) return ">99 %";
  return `${Math.round(100 * share)} %`;
}

/** Return a count with its noun. */
export function counted(count, noun) {
  return `${whole(count)} ${noun}${count === 1 ? "" : "s"}`;
}

/** Return a policy lag, and the same in updates or an empty text: a batch may make many updates. */
export function policyLag(updates, updatesPerBatch) {
  const counts = [updates, updates / updatesPerBatch].map((count) => Math.round(count * 10) / 10);
  const [inUpdates, inBatches] = [decimal(counts[0], "update"), decimal(counts[1], "batch", "batches")];
  return updatesPerBatch === 1 ? [inUpdates, ""] : [inBatches, inUpdates];
}

function decimal(count, noun, several = `${noun}s`) {
  return `${number(count)} ${count === 1 ? noun : several}`;
}
