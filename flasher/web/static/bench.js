"use strict";
// Bench page: inserts the parts that the server renders, and submits forms.

let isFocusLost = false;
// Control that was used last: it gets the focus back as soon as it is shown again.
let used = "";
// Ids of <details> that were open when shown last: the list of files is gone while these are checked.
const opened = new Map();

// Name of the file to which a <details> element belongs, if any.
function about(summary) {
  return summary.parentElement.querySelector(":scope > form [name=name]")?.value;
}

function apply(message) {
  const name = document.activeElement.id;
  isFocusLost ||= name !== "";
  for (const summary of document.querySelectorAll("details > summary[id]")) {
    if (summary.parentElement.open) {
      opened.set(summary.id, about(summary));
    } else {
      opened.delete(summary.id);
    }
  }
  for (const [id, html] of Object.entries(message.parts ?? {})) {
    byId(id).innerHTML = html;
  }
  // Keep <details> open when its part is replaced, unless it now belongs to another file.
  for (const [id, what] of opened) {
    const summary = byId(id);
    if (summary && about(summary) === what) {
      summary.parentElement.setAttribute("open", "");
    } else if (summary || what !== undefined) {
      opened.delete(id);
    }
  }
  // Restore the keyboard focus, or move it to the next control as soon as there is one.
  for (const id of isFocusLost ? [name === "now" ? used : name, used, "now"] : []) {
    if (document.activeElement === document.body) {
      byId(id)?.focus();
    }
  }
  isFocusLost &&= document.activeElement === document.body;
  byId("last").textContent = document.querySelector("#pace > p")?.textContent ?? "";
  if (message.parts?.trouble?.trim()) {
    byId("trouble").scrollIntoView({ block: "nearest" });
  }
}

async function send(path, body, limitMs) {
  const notice = byId("message");
  notice.textContent = "";
  try {
    return await post(path, body, limitMs);
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
  used = document.activeElement.id;
  const order = Object.fromEntries(new FormData(event.target, event.submitter));
  send("/bench/order", { ...order, shown_at: shownAt }, 5000);
});
addEventListener("change", (event) => event.target.type === "file" && upload(event.target.files));
addEventListener("dragover", (event) => event.preventDefault());
addEventListener("drop", (event) => {
  event.preventDefault();
  upload(event.dataTransfer.files);
});
follow(`/bench/events${location.search}`, apply);
