// The emergency stop: a request to a server of its own, from a button and from a key.
"use strict";

(() => {
  const meta = (name) => document.querySelector(`meta[name="${name}"]`).content;
  let stopping = false;

  function tell(safe, text) {
    const box = document.getElementById("pea-stopped");
    if (!box) return;
    box.textContent = text;
    box.className = safe === null ? "asked" : safe ? "safe" : "unsafe";
  }

  async function ask(url) {
    const answer = await fetch(url, {
      method: "POST", credentials: "include", signal: AbortSignal.timeout(25000),
    });
    if (!answer.ok) throw new Error(answer.statusText);
    return await answer.json();
  }

  async function stop() {
    if (stopping) return;
    stopping = true;
    tell(null, "Stopping …");
    const own = `${location.protocol}//${location.hostname}:${meta("pea-stop-port")}/stop`;
    try {
      let told;
      try { told = await ask(own); } catch { told = await ask("/stop"); }
      tell(told.safe, `${told.safe ? "Stopped" : "NOT STOPPED"}: ${told.text}`);
    } catch (error) {
      tell(false, "NOT STOPPED: the dashboard does not answer. Use the amplifier's own switch.");
    }
    stopping = false;
  }

  window.peaStop = stop;
  window.addEventListener("keydown", (event) => {
    if (event.key === "Escape" && !event.repeat) stop();
  }, true);
  document.addEventListener("click", (event) => {
    if (event.target.closest("#pea-stop")) stop();
    else if (event.target.closest("#pea-stopped.safe")) event.target.className = "";
  }, true);
})();
