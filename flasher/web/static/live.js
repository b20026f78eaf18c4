"use strict";
// The event stream of a page, and its dead man's switch: an animation of the style sheet covers the
// page three seconds after the last message, and only a message delays it. So neither a lost
// connection, a dead station nor a broken script leaves an old state visible.

const token = document.querySelector("meta[name=flasher-token]").content;
const byId = (id) => document.getElementById(id);
let shownAt = 0; // the program's time of the last message: it refuses orders that waited

function follow(path, apply) {
  let source;
  let beats = 0;
  let opened = 0;
  const isHeard = () => {
    document.body.dataset.beat = beats = 1 - beats;
    document.body.classList.remove("lost");
  };
  const isLost = () => document.body.classList.add("lost");
  const open = () => {
    opened = Date.now();
    source = new EventSource(path);
    source.onmessage = (event) => {
      const message = JSON.parse(event.data);
      shownAt = message.at;
      apply(message);
      isHeard();
      if (message.ended) {
        source.close();
        document.body.classList.add("ended");
      }
    };
    source.onerror = () => {
      isLost();
      if (source.readyState === EventSource.CLOSED) {
        setTimeout(again, 1000);
      }
    };
  };
  // A response without a stream closes it: sign-in is needed again, or the server is starting.
  const again = async () => {
    const answer = await fetch(location.href, { method: "HEAD" }).catch(() => null);
    if (answer && answer.redirected) {
      location.reload();
    }
    open();
  };
  open();
  // A browser may freeze a hidden page: reconnect when it is shown again.
  addEventListener("pageshow", (event) => event.persisted && (isLost(), source.close(), open()));
  return () => Date.now() - opened;
}

async function post(path, body, limitMs) {
  const answer = await fetch(path, {
    method: "POST",
    headers: { "x-flasher-token": token },
    body: body instanceof Blob ? body : JSON.stringify(body),
    signal: limitMs ? AbortSignal.timeout(limitMs) : null,
  });
  if (answer.status === 403) {
    location.reload(); // the server was started anew, with other tokens
  }
  if (!answer.ok) {
    throw new Error(String(answer.status));
  }
  return answer.json();
}
