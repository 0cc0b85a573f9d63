// Where the data of the page come from: the server, or the file itself if `tandem export --html` has written it.

const kept = document.getElementById("recording");
const recording = kept && JSON.parse(kept.textContent);

const of = (name) => `/api/shows/${encodeURIComponent(name)}`;

async function asked(path) {
  const answer = await fetch(path);
  return answer.ok ? answer.json() : null;
}

/** Returns the static data and the state of a mission; null if there is none of that name. */
export async function mission(name) {
  return recording ? recording.mission : asked(of(name));
}

/** Returns the scenes of the ticks from `from` to `to`, or of those of them that fit in one answer. */
export async function scenes(name, from, to) {
  if (recording) return { from: 0, to: recording.mission.last, scenes: recording.scenes };
  return asked(`${of(name)}/scenes?from=${from}&to=${to}`);
}

/** Returns the values of a mission that can be changed, or { error }. */
export const values = async (name) => answered(await fetch(`${of(name)}/values`));

/** Runs a mission with other values, and returns the name of its recording as { show }, or { error }. */
export const run_changed = async (name, changed) => answered(await posted(`${of(name)}/changed`, changed));

/** Returns the scenario file of a mission with other values as { text }, or { error }. */
export async function changed_file(name, changed) {
  const answer = await posted(`${of(name)}/changed.toml`, changed);
  return answer.ok ? { text: await answer.text() } : answered(answer);
}

const posted = (path, value) => fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(value) });

const answered = (answer) => answer.json().catch(() => ({ error: `the server refuses: ${answer.status} ${answer.statusText}` }));

/** True if the page has a server. */
export const served = !recording;

/** Returns the numbers of `robots` over time. */
export async function series(name, robots) {
  if (recording) return { ...recording.series, robots: recording.series.robots.filter((one) => robots.includes(one.robot)) };
  const fields = new URLSearchParams(robots.map((robot) => ["robot", robot]));
  return asked(`${of(name)}/series?${fields}`);
}

/** Calls `on_news` with the list of missions and the updates of `store`, and `on_lost` without a server. */
export function listen(store, on_news, on_lost) {
  if (recording) {
    if (!store) queueMicrotask(() => on_news({ list: recording.list }));
    return { close() {} };
  }
  const query = store ? `?show=${encodeURIComponent(store.name)}&since=${store.version}` : "";
  const source = new EventSource(`/api/news${query}`);
  source.onmessage = ({ data }) => on_news(JSON.parse(data));
  source.onerror = on_lost;
  return source;
}
