// Shows short messages above the shapes.

/** Milliseconds for which a message stays; what went wrong stays longer. */
const TOAST_MS = 5_000;
const FAULT_MS = 9_000;

/** Puts the messages above the shapes, so that they cover nothing that can be pressed. */
function placeToasts() {
  const box = (
    $("stage").hidden ? $("main") : document.querySelector(".scene")
  ).getBoundingClientRect();
  const room = {
    left: box.left + 14,
    bottom: window.innerHeight - Math.min(box.bottom, window.innerHeight) + 14,
  };
  for (const [side, pixels] of Object.entries(room))
    $("toasts").style[side] = `${Math.round(pixels)}px`;
}

function showToast(text, bad = false) {
  const toast = make("div", { className: bad ? "toast bad" : "toast" }, text);
  placeToasts();
  $("toasts").append(toast);
  setTimeout(() => toast.remove(), bad ? FAULT_MS : TOAST_MS);
}

const showFault = (message) => showToast(message, true);

/** Does something, and shows why it failed. Returns whether it did not fail. */
async function attempt(work, fault = showFault) {
  try {
    await work();
    return true;
  } catch (error) {
    fault(error.message);
    return false;
  }
}
