// Settings that this browser keeps for the page.

/** Returns a setting, or "" if there is none. */
function keptSetting(key) {
  try {
    return localStorage.getItem(`coseg-${key}`) ?? "";
  } catch {
    // A page that is a file may have no storage.
    return "";
  }
}

function keepSetting(key, value) {
  try {
    localStorage.setItem(`coseg-${key}`, value);
  } catch {
    // A page that is a file may have no storage.
  }
}
