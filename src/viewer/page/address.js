// Converts the state of the page to its address and back:
// `#collection/shape/view/detail?search=…&label=…&order=…`,
// and `show=proposals` in place of the cards.

/**
 * The views of a shape. Some have a detail: the shape from which a map comes, or the number of an
 * eigenfunction or a time, from 1.
 */
const VIEWS = ["labels", "eigen", "hks", "map", "history", "correct", "ask", "link"];
const ORDERS = ["arrival", "name", "doubt", "changed", "moved"];
/** What is shown in place of the cards. */
const SHOWS = ["proposals"];
const VERDICTS = ["unseen", "corrected", "approved", "doubtful"];

function decoded(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    // A person may have typed a percent sign that begins no escape.
    return text;
  }
}

/** Parses an address. Fields that are missing or unknown are null. */
function readAddress(hash) {
  const [path, query = ""] = hash.replace(/^#/, "").split(/\?(.*)/s);
  const [collection, shape, view, detail] = path.split("/").map(decoded);
  const asked = new URLSearchParams(query);
  const label = asked.get("label");
  return {
    collection: collection || null,
    shape: shape || null,
    view: VIEWS.includes(view) ? view : null,
    detail: detail || null,
    search: asked.get("search") ?? "",
    label: /^\d+$/.test(label ?? "") ? Number(label) : null,
    review: VERDICTS.includes(asked.get("review")) ? asked.get("review") : null,
    show: !shape && SHOWS.includes(asked.get("show")) ? asked.get("show") : null,
    order: ORDERS.includes(asked.get("order")) ? asked.get("order") : "arrival",
  };
}

function writeAddress(address) {
  const { collection, shape, view, detail, search, label, review, show, order } = address;
  const path = shape ? [collection, shape, view ?? "labels", detail] : [collection];
  const said = path.filter((part) => part !== null && part !== undefined && part !== "");
  const asked = new URLSearchParams();
  if (search) asked.set("search", search);
  if (label !== null && label !== undefined) asked.set("label", label);
  if (review) asked.set("review", review);
  if (show && !shape) asked.set("show", show);
  if (order && order !== "arrival") asked.set("order", order);
  const query = asked.toString();
  return `#${said.map((part) => encodeURIComponent(part)).join("/")}${query ? `?${query}` : ""}`;
}
