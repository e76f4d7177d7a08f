// Shows all shapes in the colours of their labels, and draws each when it becomes visible.

/**
 * Milliseconds that drawing small pictures may take in a frame. Without a graphics card, a frame
 * costs far more than its pictures, so there should be few frames.
 */
const BUDGET_MS = 150;
/** Maximum number of milliseconds for which reading waits for drawing. */
const PATIENCE_MS = 500;
const $ = (id) => document.getElementById(id);

/**
 * Characters that are invisible or turn the direction of others; the same as in
 * src/library/names.rs.
 */
const HIDDEN = new RegExp(
  String.raw`[\u00ad\u034f\u061c\u115f\u1160\u17b4\u17b5\u180e\u200b\u200e\u200f\u2028-\u202e` +
    String.raw`\u2060-\u206f\u3164\ufeff\uffa0\ufff0-\ufffb\u{1d173}-\u{1d17a}\u{e0000}-\u{e007f}]`,
  "gu",
);
/** Letters that look like Latin ones. */
const LOOKALIKES = /[АВЕКМНОРСТУХаеорсухіІјЈѕЅһԁԛԜԝҮүӀӏΑΒΕΖΗΙΚΜΝΟΡΤΥΧοναινυρ]/gu;
/**
 * Returns text that contains names, for people: invisible characters, and lookalikes beside Latin
 * letters, are replaced by their numbers.
 */
function shown(text) {
  const number = (c) => `\\u{${c.codePointAt(0).toString(16)}}`;
  const mixed = (word) => (/[A-Za-z]/.test(word) ? word.replace(LOOKALIKES, number) : word);
  return text.replace(/\p{L}+/gu, mixed).replace(HIDDEN, number);
}

/**
 * Makes an element with properties, attributes (`aria-…`, `data-…`, `role`) and children; strings
 * become text.
 */
function make(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(properties))
    if (key.includes("-") || key === "role") element.setAttribute(key, value);
    else element[key] = value;
  const there = children.filter((c) => c !== null && c !== undefined);
  element.append(...there.map((c) => (typeof c === "string" ? shown(c) : c)));
  return element;
}

/**
 * Replaces the content of an element. The element with the focus keeps it, or its successor in the
 * same position gets it.
 */
function keepingFocus(root, replace) {
  const all = () => [...root.querySelectorAll("button, select, input, [tabindex]")];
  const at = all().indexOf(document.activeElement);
  replace();
  if (at >= 0 && !root.contains(document.activeElement)) all()[at]?.focus();
}

/**
 * Returns the position to which an arrow key, Home or End leads from `at`, among `count` items in
 * rows of `columns`; null for other keys.
 */
function moved(at, count, columns, key) {
  const to = {
    ArrowLeft: at - 1,
    ArrowRight: at + 1,
    ArrowUp: at - columns,
    ArrowDown: at + columns,
    Home: 0,
    End: count - 1,
  }[key];
  if (to === undefined || at < 0 || (columns === 1 && /Up|Down/.test(key))) return null;
  return to < 0 || to >= count ? at : to;
}

const css = ([r, g, b]) => `rgb(${r | 0} ${g | 0} ${b | 0})`;
const swatch = (colour) => {
  const element = make("span", { className: "swatch" });
  element.style.background = css(colour);
  return element;
};
const percent = (share) =>
  share > 0 && share < 0.0005 ? "< 0.1 %" : `${(100 * share).toFixed(share < 0.0995 ? 1 : 0)} %`;

/** Draws small pictures of shapes, some in each frame, in the order of the requests. */
class Thumbnails {
  constructor(app) {
    this.app = app;
    this.raster = new Raster();
    this.waiting = new Map();
    this.running = false;
  }

  ask(canvas, name) {
    this.waiting.set(canvas, name);
    if (this.running) return;
    this.running = true;
    requestAnimationFrame(() => this.frame());
  }

  frame() {
    const begin = performance.now();
    // Reads all sizes first: reading one after a change of a canvas would compute the layout again.
    const sizes = new Map([...this.waiting.keys()].map((canvas) => [canvas, this.size(canvas)]));
    for (const [canvas, name] of this.waiting) {
      this.waiting.delete(canvas);
      const portrait = this.app.changes.before(name) ?? this.app.portraits.get(name);
      try {
        if (portrait && canvas.isConnected) this.draw(canvas, portrait, sizes.get(canvas));
      } catch (error) {
        // The other pictures are drawn in spite of the error.
        console.error(name, error);
      }
      if (performance.now() - begin > BUDGET_MS) break;
    }
    this.running = this.waiting.size > 0;
    if (this.running) requestAnimationFrame(() => this.frame());
    else this.rested();
  }

  rested() {
    this.app.thumbnailsDrawn();
    this.atRest?.();
  }

  /**
   * Resolves when nothing waits to be drawn, or soon if nothing is drawn at all, as in a hidden
   * page.
   */
  idle() {
    if (!this.running) return new Promise((resolve) => setTimeout(resolve));
    return new Promise((resolve) => {
      this.atRest = resolve;
      setTimeout(resolve, PATIENCE_MS);
    });
  }

  /** Returns the size of a picture in pixels. */
  size(canvas) {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    return [canvas.clientWidth, canvas.clientHeight].map((n) =>
      Math.max(Math.round(n * ratio), 16),
    );
  }

  draw(canvas, portrait, [width, height]) {
    const { app, raster } = this;
    const picture = raster.picture(
      new Mesh(portrait, app.up),
      (label) => app.shownColour(label),
      width,
      height,
    );
    [canvas.width, canvas.height] = [width, height];
    // The picture comes from memory, so it should not pass through an emulated graphics card.
    canvas.getContext("2d", { willReadFrequently: true }).putImageData(picture, 0, 0);
    canvas.dataset.drawn = portrait.version;
  }
}

/** The grid of cards. */
class Gallery {
  constructor(app) {
    this.app = app;
    this.root = $("gallery");
    this.cards = new Map();
    const near = { root: this.root, rootMargin: "150px" };
    this.sight = new IntersectionObserver((entries) => this.seen(entries), near);
    // Cards have another size beside an open shape.
    new ResizeObserver(() => {
      for (const name of this.cards.keys()) this.draw(name);
    }).observe(this.root);
    this.root.addEventListener("click", (event) => {
      const card = event.target.closest(".card");
      if (card) app.go({ shape: card.dataset.name, detail: null });
    });
    this.root.addEventListener("keydown", (event) => {
      // Beside an open shape, these keys go to other shapes.
      if (app.selected && /^Arrow(Left|Right)$/.test(event.key)) return;
      const cards = [...this.root.children];
      const columns = getComputedStyle(this.root).gridTemplateColumns.split(" ").length;
      const at = cards.indexOf(event.target);
      // In one column, arrows up and down move by one card.
      const key =
        columns === 1 ? event.key.replace("Up", "Left").replace("Down", "Right") : event.key;
      const next = moved(at, cards.length, columns, key);
      if (next === null) return;
      event.preventDefault();
      cards[next].focus();
    });
  }

  /** Shows these shapes in this order. */
  show(shapes) {
    const wanted = new Set(shapes.map((s) => s.name));
    for (const [name, card] of this.cards)
      if (!wanted.has(name)) {
        this.sight.unobserve(card);
        card.remove();
        this.cards.delete(name);
      }
    const cards = shapes.map((shape) => {
      const card = this.cards.get(shape.name) ?? this.card(shape);
      this.describe(card, shape);
      return card;
    });
    if (cards.some((card, i) => this.root.children[i] !== card))
      this.root.replaceChildren(...cards);
  }

  card(shape) {
    const card = make(
      "button",
      { className: "card", "data-name": shape.name },
      make("canvas", { "aria-hidden": "true" }),
      make(
        "span",
        { className: "foot" },
        make("span", { className: "name" }),
        make("span", { className: "moved" }),
        make("span", { className: "mark" }),
        make("span", { className: "signed" }),
      ),
    );
    this.cards.set(shape.name, card);
    this.sight.observe(card);
    return card;
  }

  /** Says on a card what is known of its shape. */
  describe(card, shape) {
    const { app } = this;
    const [name, share, mark, signed] = card.querySelectorAll(".foot > span");
    name.textContent = shown(shape.name);
    const state = stateOf(shape);
    const doubt = state === "doubtful" || (state === "unseen" && certainty(shape) < 0.6);
    const verdict = state === "unseen" ? (doubt ? "unsure" : "") : `${MARKS[state]} ${state}`;
    mark.textContent = shape.stale ? "waiting" : verdict;
    mark.className = `mark ${doubt && !shape.stale ? "doubt" : state}`;
    mark.hidden = !mark.textContent;
    const moved = app.changes.moved(shape.name);
    share.textContent = moved ? `± ${percent(moved)}` : "";
    share.title = moved ? "Share of its area that the last change moved" : "";
    signed.textContent = state === "unseen" ? "" : shown(signature(shape.review));
    signed.hidden = !signed.textContent;
    const parts = `${counted(shape.n_polygons, "face")}, ${counted(shape.parts.length, "part")}`;
    card.title = `${shape.name}: ${parts}; ${verdictText(shape)}`;
    card.setAttribute("aria-current", String(app.selected === shape.name));
  }

  /** Returns the names of the shapes in sight, that of the large one first. */
  inSight() {
    const seen = [...this.root.children].filter((card) => card.inSight && card.checkVisibility());
    const names = seen.map((card) => card.dataset.name);
    return [...new Set([this.app.selected, ...names].filter(Boolean))];
  }

  describeAll() {
    for (const [name, card] of this.cards) {
      const shape = this.app.shape(name);
      if (shape) this.describe(card, shape);
    }
  }

  seen(entries) {
    for (const { target, isIntersecting } of entries) {
      target.inSight = isIntersecting;
      const canvas = target.firstChild;
      if (isIntersecting) this.draw(target.dataset.name);
      // Thousands of pictures would not fit into memory.
      else if (canvas.dataset.drawn && this.cards.size > 800) {
        [canvas.width, canvas.height] = [1, 1];
        delete canvas.dataset.drawn;
      }
    }
  }

  /** Draws a shape's picture if it is visible and not up to date. */
  draw(name, again = false) {
    const card = this.cards.get(name);
    const portrait = this.app.portraits.get(name);
    if (!card?.inSight || !portrait) {
      if (card && again) delete card.firstChild.dataset.drawn;
      return;
    }
    const size = `${card.clientWidth} ${portrait.version}`;
    if (!again && card.drawnAs === size && card.firstChild.dataset.drawn) return;
    card.drawnAs = size;
    this.app.thumbnails.ask(card.firstChild, name);
  }

  /** Draws all visible pictures again. */
  redraw() {
    for (const name of this.cards.keys()) this.draw(name, true);
  }

  select(name) {
    for (const card of this.cards.values())
      card.setAttribute("aria-current", String(card.dataset.name === name));
    this.cards.get(name)?.scrollIntoView({ block: "nearest" });
  }
}

/** Returns the mean probability of a shape's labels. */
function certainty(shape) {
  return shape.parts.reduce((sum, p) => sum + p.area_share * p.confidence, 0);
}
