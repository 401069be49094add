// The emergency stop: a request to a server of its own, from a button and from a key. It needs
// nothing else of the page: neither its elements nor its other scripts.
"use strict";

(() => {
  const LONGEST = 60000;  // ms that the dashboard has to answer; it escalates meanwhile
  const UNEASY = 3000;  // ms after which an answer that is still due is shown in red
  const UNKNOWN = "the stage is not known to be safe: use the amplifier's own switch";
  let stopping = false;

  function made(tag, id, parent) {
    const element = document.createElement(tag);
    element.id = id;
    parent.append(element);
    return element;
  }

  function box() {
    if (document.getElementById("pea-stop-box")) return;
    const all = made("div", "pea-stop-box", document.body);
    const button = made("button", "pea-stop", all);
    button.type = "button";
    button.append("STOP ");
    made("small", "pea-stop-key", button).textContent = "Esc";
    button.addEventListener("click", stop);
    const told = made("div", "pea-stopped", all);
    told.setAttribute("role", "alert");
    const close = () => { if (told.className === "safe") tell("", ""); };
    told.addEventListener("click", close);
    told.addEventListener("keydown", (event) => { if (event.key === "Enter") close(); });
  }

  // What was done, across the page; the page below makes room for it.
  function tell(kind, text) {
    box();
    const told = document.getElementById("pea-stopped");
    told.textContent = text;
    told.className = kind;
    told.tabIndex = kind === "safe" ? 0 : -1;  // Enter closes it
    document.documentElement.style.setProperty("--pea-told", `${told.offsetHeight}px`);
  }

  async function ask(url) {
    const answer = await fetch(url, {
      method: "POST", credentials: "include", signal: AbortSignal.timeout(LONGEST),
    });
    if (!answer.ok) throw new Error(answer.statusText);
    return await answer.json();
  }

  async function stop() {
    if (stopping) return;
    stopping = true;
    const began = performance.now();
    tell("asked", "Stopping …");
    const watch = setInterval(() => {
      const s = Math.round((performance.now() - began) / 1000);
      const uneasy = performance.now() - began > UNEASY;
      tell(uneasy ? "unsafe" : "asked", `Stopping … ${s} s${uneasy ? `: ${UNKNOWN}` : ""}`);
    }, 500);
    const port = document.querySelector('meta[name="pea-stop-port"]')?.content;
    const own = `${location.protocol}//${location.hostname}:${port}/stop`;
    let told;
    try {
      try { told = await ask(own); } catch { told = await ask("/stop"); }
    } catch {
      told = { safe: false, text: `the dashboard does not answer; ${UNKNOWN}` };
    }
    clearInterval(watch);
    tell(told.safe ? "safe" : "unsafe", `${told.safe ? "Stopped" : "NOT STOPPED"}: ${told.text}`);
    stopping = false;
  }

  window.peaStop = stop;
  window.addEventListener("keydown", (event) => {
    if (event.key === "Escape" && !event.repeat) stop();
  }, true);
  if (document.body) box();
  else document.addEventListener("DOMContentLoaded", box);
  // a page that is built anew may drop what it has not made
  setInterval(() => { if (document.body) box(); }, 1000);
})();
