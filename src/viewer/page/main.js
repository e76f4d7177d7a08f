// Starts the page: light or dark, live or from the file itself.

function setTheme(theme, keep) {
  document.documentElement.dataset.theme = theme;
  if (keep) keepSetting("theme", theme);
}

setTheme(
  keptSetting("theme") || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"),
  false,
);
const embedded = $("catalogue");
try {
  const app = new App(embedded ? new EmbeddedSource(embedded) : new LiveSource());
  await app.start();
} catch (error) {
  $("empty").hidden = false;
  $("empty").replaceChildren(
    make("h2", {}, "The viewer cannot start"),
    make("div", {}, error.message),
  );
  document.documentElement.dataset.ready = "failed";
  throw error;
}
