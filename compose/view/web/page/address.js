// The address of the page: #show=…&tick=46&robot=a&truth=0.

/** Returns what the address asks for; `tick` is null if it names none. */
export function address_state() {
  const fields = new URLSearchParams(location.hash.slice(1));
  const tick = fields.get("tick");
  return {
    show: fields.get("show"),
    tick: tick !== null && /^\d+$/.test(tick) ? Number(tick) : null,
    robot: fields.get("robot"),
    truth: fields.get("truth") !== "0",
  };
}
