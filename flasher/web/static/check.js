"use strict";
// Page that checks certificates: uploads a file or text, and shows the result.

byId("check").addEventListener("submit", async (event) => {
  event.preventDefault();
  const form = event.target;
  const code = form.elements.code.value.trim();
  const body = code ? new Blob([code]) : form.elements.file.files[0];
  if (!body) {
    form.elements.file.focus();
    return;
  }
  const found = byId("found");
  found.textContent = "";
  try {
    const answer = await fetch(location.href, {
      method: "POST",
      headers: { "x-flasher-token": token },
      body,
    });
    const page = new DOMParser().parseFromString(await answer.text(), "text/html");
    found.replaceChildren(...page.getElementById("found").childNodes);
  } catch {
    found.textContent = form.dataset.failed;
  }
});
