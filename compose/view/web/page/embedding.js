// The page inside a page that compares two recordings, which has the clock (#embed=1&show=left).

const KEYS = [" ", "ArrowLeft", "ArrowRight", "PageDown", "PageUp", "Home", "End", "[", "]", "l"];

/** True if this page is a frame of compare.html, and has no clock of its own. */
export const embedded = parent !== window && new URLSearchParams(location.hash.slice(1)).get("embed") === "1";
if (embedded) document.body.classList.add("embed");

let told = "";

/** Sends a message to the page with the clock. */
export function tell(message) {
  parent.postMessage(message, location.origin);
}

/** Sends the tick that is shown, and the first and the last tick of the recording, when they change. */
export function tell_state(state) {
  const text = JSON.stringify(state);
  if (!embedded || text === told) return;
  told = text;
  tell(state);
}

/** Passes a key of the clock on; returns true if it was one. */
export function pass_on(event) {
  const { key, shiftKey } = event;
  if (!embedded || !KEYS.includes(key)) return false;
  event.preventDefault();
  tell({ key, shiftKey });
  return true;
}

/** Calls `set` with the state of the clock, {tick, share, playing}, whenever it changes. */
export function on_clock(set) {
  if (!embedded) return;
  window.addEventListener("message", ({ origin, source, data }) => {
    if (origin === location.origin && source === parent) set(data);
  });
}
