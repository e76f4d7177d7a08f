// What the page shows becomes its address and back: `#collection/shape/view/detail?search=…&label=…&order=…`.

/** The views of a shape. A detail belongs to some: the shape a map comes from, an eigenfunction or a time, from 1. */
const VIEWS = ["labels", "eigen", "hks", "map", "history", "correct", "ask"];
const ORDERS = ["arrival", "name", "doubt", "changed", "moved"];
const VERDICTS = ["unseen", "corrected", "approved", "doubtful"];

function decoded(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    // A person may have typed a lone percent sign.
    return text;
  }
}

/** What an address says. What it does not say, or not in words of this page, is null. */
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
    order: ORDERS.includes(asked.get("order")) ? asked.get("order") : "arrival",
  };
}

function writeAddress({ collection, shape, view, detail, search, label, review, order }) {
  const path = shape ? [collection, shape, view ?? "labels", detail] : [collection];
  const said = path.filter((part) => part !== null && part !== undefined && part !== "");
  const asked = new URLSearchParams();
  if (search) asked.set("search", search);
  if (label !== null && label !== undefined) asked.set("label", label);
  if (review) asked.set("review", review);
  if (order && order !== "arrival") asked.set("order", order);
  const query = asked.toString();
  return `#${said.map((part) => encodeURIComponent(part)).join("/")}${query ? `?${query}` : ""}`;
}
