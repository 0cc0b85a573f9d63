// The keyboard focus: which keys its element needs, and when it is released.

/** True if the focused element handles that key itself. */
export function needed({ target, key }) {
  const { tagName, type } = target;
  if (target.closest("dialog")) return false; // the dialog has just closed and still has the focus
  if (["INPUT", "SELECT"].includes(tagName) && target.form?.id === "changes") return true;
  if (tagName === "SELECT") {
    return ["ArrowUp", "ArrowDown", "Enter"].includes(key) || (target.id === "robot" ? /^[\w-]$/ : /^\d$/).test(key);
  }
  return [" ", "Enter"].includes(key) && (["BUTTON", "A"].includes(tagName) || (tagName === "INPUT" && type === "checkbox"));
}

/** Removes the focus from a control after a click, so that the space key starts playback. */
export function release_focus() {
  let pointing = false;
  for (const [name, on] of [["pointerdown", true], ["keydown", false]]) document.addEventListener(name, () => { pointing = on; }, true);
  for (const name of ["click", "change"]) {
    document.addEventListener(name, ({ target }) => {
      const control = target.closest("button, a, select, input[type=checkbox]");
      if (pointing && control && (name === "change" || control.tagName !== "SELECT")) control.blur();
    });
  }
}
