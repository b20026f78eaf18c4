"use strict";
// Operator page: displays the messages of the station.

const SHAPES = {
  starting: "M6 2h12v4l-4.5 6 4.5 6v4H6v-4l4.5-6L6 6z",
  empty: "M3 3h4v2H5v2H3zM17 3h4v4h-2V5h-2zM3 17h2v2h2v2H3zM19 17h2v4h-4v-2h2z",
  silent: "M12 2a7 7 0 0 1 4 12.7V17h-4v-4.2a3.8 3.8 0 1 0-3.8-3.8H5a7 7 0 0 1 7-7zM12 19h4v4h-4z",
  scan: "M2 4h3v16H2zM7 4h1v16H7zM10 4h3v16h-3zM15 4h1v16h-1zM18 4h1v16h-1zM20 4h2v16h-2z",
  running: "M5 3l16 9-16 9z",
  saving: "M3 3h14l4 4v14H3zM7 5v6h9V5zM12 6h3v4h-3zM7 14v5h10v-5z",
  pass: "M9.5 20.5L1.5 12.5 5 9l4.5 4.5L19 4l3.500 3.500z",
  fail: "M4.500 1L12 8.500 19.500 1 23 4.500 15.500 12 23 19.500 19.500 23 12 15.500 4.500 23 1 19.500 8.500 12 1 4.500z",
  recheck: "M12 3a9 9 0 0 1 7.600 4.200L22 5v8h-8l3.300-3.300A6 6 0 1 0 18 14h3.200A9.300 9.300 0 1 1 12 3z",
  error: "M12 1l11.500 21H.5zM10.500 8v7h3V8zM10.500 17v3h3v-3z",
  stopped: "M7.500 1h9L23 7.500v9L16.500 23h-9L1 16.500v-9zM5 10v4h14v-4z",
};
const TONES = { pass: [660, 880], fail: [220, 160], recheck: [440, 330], error: [220, 160] };
const REFUSED = [330, 330, 330];
const tiles = new Map();
let audio = null;
let isFirst = true;

function put(element, text) {
  if (element.textContent !== text) {
    element.textContent = text;
  }
}

// Width in Latin capitals; a Chinese character is as wide as high.
const widthOf = (word) => [...word].reduce((sum, char) => sum + (char > "\u2e80" ? 1.4 : 1), 0);

function sound(tones) {
  if (!audio || audio.state !== "running") {
    return;
  }
  tones.forEach((pitch, at) => {
    const tone = new OscillatorNode(audio, { frequency: pitch, type: "triangle" });
    const gain = new GainNode(audio, { gain: Number(document.body.dataset.volume) });
    tone.connect(gain).connect(audio.destination);
    tone.start(audio.currentTime + at * 0.2);
    tone.stop(audio.currentTime + at * 0.2 + 0.16);
  });
}

function show(tile) {
  let article = tiles.get(tile.socket);
  if (!article) {
    article = byId("tile").content.firstElementChild.cloneNode(true);
    tiles.set(tile.socket, article);
    byId("tiles").append(article);
    byId("tiles").dataset.count = tiles.size;
  }
  const part = (name) => article.querySelector("." + name);
  if (article.dataset.state !== tile.state) {
    article.querySelector("path").setAttribute("d", SHAPES[tile.state]);
    if (!isFirst && TONES[tile.state]) {
      sound(TONES[tile.state]);
    }
  }
  article.dataset.state = tile.state;
  article.dataset.serial = tile.serial;
  article.classList.toggle("borne", !tile.is_label);
  put(part("name"), tile.socket);
  put(part("virtual"), tile.virtual);
  put(part("word"), tile.word);
  part("verdict").style.setProperty("--letters", Math.max(widthOf(tile.word), 4));
  put(part("tail"), tile.tail);
  part("tail").title = tile.serial;
  const bar = article.querySelector("progress");
  bar.hidden = tile.share === null;
  bar.value = tile.share ?? 0;
  bar.setAttribute("aria-label", tile.word);
  put(part("step"), tile.code || tile.step);
  put(part("left"), tile.left);
  put(part("what"), tile.line);
}

function showHead(head) {
  for (const name of ["station", "recipe", "part", "operator", "lot", "hour", "shift", "first"]) {
    put(byId(name), head[name]);
  }
  if (head.virtual) {
    put(byId("part"), `${head.part} · ${head.virtual}`);
  }
  put(byId("causes"), head.causes.join(", ") || "-");
  if (byId("spoken").textContent !== head.spoken && head.is_refusal && !isFirst) {
    sound(REFUSED);
  }
  put(byId("spoken"), head.spoken);
  byId("spoken").classList.toggle("refused", head.is_refusal);
  byId("scan").type = head.is_secret ? "password" : "text";
  byId("health").replaceChildren(...head.health.map((check) => {
    const item = document.createElement("li");
    item.textContent = `${check.name}: ${check.text}`;
    item.className = check.is_good ? "good" : "bad";
    return item;
  }));
  if (head.withdrawn) {
    const item = document.createElement("li");
    item.textContent = head.withdrawn;
    item.className = "bad";
    byId("health").prepend(item);
  }
  showOffers(head);
  byId("stopped").hidden = !head.stopped;
  for (const name of ["reason", "remedy", "code"]) {
    put(byId("stopped-" + name), head.stopped ? head.stopped[name] : "");
  }
}

// Built again only when it changes, so that a list keeps its place while it is read. A new recipe
// closes it: the button of another recipe must not come under the finger.
let offered = "[]";

function showOffers(head) {
  const now = JSON.stringify(head.offered);
  byId("show-offers").hidden = head.offered.length === 0;
  if (now === offered) {
    return;
  }
  const known = new Set(JSON.parse(offered).map((offer) => offer.digest));
  const isNew = head.offered.some((offer) => !known.has(offer.digest));
  offered = now;
  byId("offers").hidden ||= isNew || head.offered.length === 0;
  byId("offer-list").replaceChildren(...head.offered.map((offer) => {
    const box = byId("offer").content.firstElementChild.cloneNode(true);
    const part = (name) => box.querySelector(name);
    put(part("h3"), offer.recipe);
    for (const name of ["sockets", "digest", "published", "problem"]) {
      put(part("." + name), offer[name]);
    }
    part(".problem").hidden = !offer.problem;
    for (const name of ["h4", "ul", ".approve"]) {
      part(name).hidden = !offer.scan;
    }
    part("ul").replaceChildren(...offer.changes.map((change) => {
      const item = document.createElement("li");
      item.textContent = change;
      return item;
    }));
    put(part(".approve b"), offer.scan);
    part(".approve button").addEventListener("click", () => {
      scanned(offer.scan);
    });
    return box;
  }));
}

function apply(message) {
  if (message.all) {
    const known = new Set((message.tiles ?? []).map((tile) => tile.socket));
    for (const [name, article] of tiles) {
      if (!known.has(name)) {
        article.remove();
        tiles.delete(name);
      }
    }
  }
  (message.tiles ?? []).forEach(show);
  if (message.head) {
    showHead(message.head);
  }
  isFirst = false;
}

// -- scans: a scanner is a keyboard, and types wherever the focus is ------------------------------

const waiting = [];
let isSending = false;

const scanned = (text) => {
  waiting.push({ text, shown_at: shownAt });
  send();
};

async function send() {
  if (isSending) {
    return;
  }
  isSending = true;
  while (waiting.length) {
    try {
      await post("/line/scan", waiting[0], 5000);
      waiting.shift();
    } catch {
      waiting.length = 0; // an old scan must not come by itself when other units are in the sockets
      put(byId("spoken"), document.body.dataset.notSent);
      byId("spoken").classList.add("refused");
      sound(REFUSED);
    }
  }
  isSending = false;
}

addEventListener("keydown", (event) => {
  const field = byId("scan");
  if (event.ctrlKey || event.altKey || event.metaKey || event.isComposing) {
    return;
  }
  if (event.key === "Enter") {
    if (event.target.tagName === "BUTTON" && !field.value) {
      return;
    }
    event.preventDefault();
    const text = field.value;
    field.value = "";
    if (text.trim()) {
      scanned(text);
    }
  } else if (event.key === "Escape") {
    field.value = "";
  } else if (event.target !== field && event.key.length === 1) {
    if (event.target.tagName === "BUTTON" && event.key === " " && !field.value) {
      return;
    }
    event.preventDefault();
    field.value += event.key;
    field.focus();
  }
});

byId("show-offers").addEventListener("click", () => { byId("offers").hidden = false; });
byId("hide-offers").addEventListener("click", () => { byId("offers").hidden = true; });

byId("sounds").addEventListener("click", async () => {
  audio = audio ?? new AudioContext();
  await audio.resume();
  const all = [TONES.pass, TONES.fail, REFUSED];
  all.forEach((tones, at) => setTimeout(() => sound(tones), at * 900));
});

setInterval(() => put(byId("clock"), new Date().toLocaleTimeString(document.documentElement.lang)), 500);
follow(`/line/events${location.search}`, apply);
