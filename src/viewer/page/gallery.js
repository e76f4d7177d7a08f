// All shapes in the colours of their labels, drawn when they come into sight.

/**
 * Milliseconds of a frame that drawing small pictures may take. Without a graphics card a frame costs far more than the
 * pictures in it, so there should be few.
 */
const BUDGET_MS = 150;
/** Milliseconds for which reading waits for drawing. */
const PATIENCE_MS = 500;
const $ = (id) => document.getElementById(id);

/** Characters that show nothing of themselves or turn the direction of others, as src/library/names.rs has them. */
const HIDDEN =
  /[\u00ad\u034f\u061c\u115f\u1160\u17b4\u17b5\u180e\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\u3164\ufeff\uffa0\ufff0-\ufffb\u{1d173}-\u{1d17a}\u{e0000}-\u{e007f}]/gu;
/** Letters that look like Latin ones. */
const LOOKALIKES = /[АВЕКМНОРСТУХаеорсухіІјЈѕЅһԁԛԜԝҮүӀӏΑΒΕΖΗΙΚΜΝΟΡΤΥΧοναινυρ]/gu;
/** Text with names in it for people: those characters, and such letters beside Latin ones, are written as numbers. */
function shown(text) {
  const number = (c) => `\\u{${c.codePointAt(0).toString(16)}}`;
  const mixed = (word) => (/[A-Za-z]/.test(word) ? word.replace(LOOKALIKES, number) : word);
  return text.replace(/\p{L}+/gu, mixed).replace(HIDDEN, number);
}

/** An element with properties, attributes (`aria-…`, `data-…`, `role`) and children; strings become text. */
function make(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(properties))
    if (key.includes("-") || key === "role") element.setAttribute(key, value);
    else element[key] = value;
  const there = children.filter((c) => c !== null && c !== undefined);
  element.append(...there.map((c) => (typeof c === "string" ? shown(c) : c)));
  return element;
}

/** Replaces what is in an element; what has the focus there keeps it, or its successor in the same place gets it. */
function keepingFocus(root, replace) {
  const all = () => [...root.querySelectorAll("button, select, input, [tabindex]")];
  const at = all().indexOf(document.activeElement);
  replace();
  if (at >= 0 && !root.contains(document.activeElement)) all()[at]?.focus();
}

/** Where an arrow key, Home or End leads from one of `count` in rows of `columns`; null for other keys. */
function moved(at, count, columns, key) {
  const to = { ArrowLeft: at - 1, ArrowRight: at + 1, ArrowUp: at - columns, ArrowDown: at + columns, Home: 0, End: count - 1 }[key];
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

/** Draws small pictures of shapes, some in each frame, in the order in which they were asked for. */
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
    // Sizes first: asking for one after a canvas has changed would lay the page out again.
    const sizes = new Map([...this.waiting.keys()].map((canvas) => [canvas, this.size(canvas)]));
    for (const [canvas, name] of this.waiting) {
      this.waiting.delete(canvas);
      const portrait = this.app.changes.before(name) ?? this.app.portraits.get(name);
      try {
        if (portrait && canvas.isConnected) this.draw(canvas, portrait, sizes.get(canvas));
      } catch (error) {
        // The others are drawn all the same.
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

  /** Resolves when nothing waits to be drawn; soon where nothing is drawn at all, as in a page that nobody sees. */
  idle() {
    if (!this.running) return new Promise((resolve) => setTimeout(resolve));
    return new Promise((resolve) => {
      this.atRest = resolve;
      setTimeout(resolve, PATIENCE_MS);
    });
  }

  /** Pixels of a picture. */
  size(canvas) {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    return [canvas.clientWidth, canvas.clientHeight].map((n) => Math.max(Math.round(n * ratio), 16));
  }

  draw(canvas, portrait, [width, height]) {
    const { app, raster } = this;
    const picture = raster.picture(new Mesh(portrait, app.up), (label) => app.shownColour(label), width, height);
    [canvas.width, canvas.height] = [width, height];
    // In memory: a picture that comes from there is not to travel by way of an emulated graphics card.
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
    this.root.addEventListener("click", (event) => {
      const card = event.target.closest(".card");
      if (card) app.go({ shape: card.dataset.name, detail: null });
    });
    this.root.addEventListener("keydown", (event) => {
      // Beside an open shape these go to other shapes.
      if (app.selected && /^Arrow(Left|Right)$/.test(event.key)) return;
      const cards = [...this.root.children];
      const columns = getComputedStyle(this.root).gridTemplateColumns.split(" ").length;
      const at = cards.indexOf(event.target);
      // One column is walked up and down.
      const key = columns === 1 ? event.key.replace("Up", "Left").replace("Down", "Right") : event.key;
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
    if (cards.some((card, i) => this.root.children[i] !== card)) this.root.replaceChildren(...cards);
  }

  card(shape) {
    const card = make(
      "button",
      { className: "card", "data-name": shape.name },
      make("canvas", { "aria-hidden": "true" }),
      make("span", { className: "foot" }, make("span", { className: "name" }), make("span", { className: "mark" })),
    );
    this.cards.set(shape.name, card);
    this.sight.observe(card);
    return card;
  }

  describe(card, shape) {
    const [name, mark] = card.querySelectorAll(".foot span");
    name.textContent = shown(shape.name);
    card.title = `${shape.name}: ${shape.n_polygons} faces, ${shape.parts.length} parts`;
    const doubt = certainty(shape) < 0.6;
    const verdict = { approved: "✓ approved", doubtful: "? doubtful", corrected: "✎ corrected" }[shape.review?.state];
    mark.textContent = shape.stale ? "waiting" : verdict ?? (doubt ? "unsure" : "");
    mark.classList.toggle("doubt", doubt && !shape.stale);
    card.setAttribute("aria-current", String(this.app.selected === shape.name));
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

  /** Draws a shape's picture if it is in sight and not drawn as it is. */
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

  /** Draws all that are in sight again. */
  redraw() {
    for (const name of this.cards.keys()) this.draw(name, true);
  }

  select(name) {
    for (const card of this.cards.values())
      card.setAttribute("aria-current", String(card.dataset.name === name));
    this.cards.get(name)?.scrollIntoView({ block: "nearest" });
  }
}

/** Mean probability of a shape's labels. */
function certainty(shape) {
  return shape.parts.reduce((sum, p) => sum + p.area_share * p.confidence, 0);
}
