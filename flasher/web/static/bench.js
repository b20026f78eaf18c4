"use strict";
// The bench page: puts the pieces that the server made into the page, and sends what was chosen.

let isFocusLost = false;

// The file that an unfolding text is about, if it is about one.
function about(summary) {
  return summary.parentElement.querySelector(":scope > form [name=name]")?.value;
}

function apply(message) {
  const name = document.activeElement.id;
  isFocusLost ||= name !== "";
  const opened = [...document.querySelectorAll("details[open] > summary[id]")]
    .map((summary) => [summary.id, about(summary)]);
  for (const [id, html] of Object.entries(message.parts ?? {})) {
    byId(id).innerHTML = html;
  }
  // What was unfolded stays so when its piece comes anew, unless it is about another file by now.
  for (const [id, what] of opened) {
    const summary = byId(id);
    if (summary && about(summary) === what) {
      summary.parentElement.setAttribute("open", "");
    }
  }
  // Who uses the keyboard is where he was, or at what is wanted now, as soon as something is.
  for (const id of isFocusLost ? [name, "now"] : []) {
    if (document.activeElement === document.body) {
      byId(id)?.focus();
    }
  }
  isFocusLost &&= document.activeElement === document.body;
}

async function send(path, body) {
  const notice = byId("message");
  notice.textContent = "";
  try {
    return await post(path, body);
  } catch (error) {
    notice.textContent = document.body.dataset[`message${error.message}`] ?? document.body.dataset.message;
  }
}

async function upload(files) {
  let page;
  for (const file of files) {
    page = (await send(`/bench/upload?name=${encodeURIComponent(file.name)}`, file))?.page ?? page;
  }
  if (page) {
    location.assign(page);
  }
}

addEventListener("submit", (event) => {
  event.preventDefault();
  send("/bench/order", Object.fromEntries(new FormData(event.target, event.submitter)));
});
addEventListener("change", (event) => event.target.type === "file" && upload(event.target.files));
addEventListener("dragover", (event) => event.preventDefault());
addEventListener("drop", (event) => {
  event.preventDefault();
  upload(event.dataTransfer.files);
});
follow(`/bench/events${location.search}`, apply);
