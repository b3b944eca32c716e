/* Light or dark, as the person chose in this browser; without a choice, as the system is. No module: it runs before anything is drawn. */
(() => {
  const KEPT = "relit-theme";
  const root = document.documentElement;
  const system = matchMedia("(prefers-color-scheme: dark)");
  const kept = () => { try { return localStorage.getItem(KEPT); } catch { return null; } }; // a browser may forbid to keep anything
  const isDark = () => (root.dataset.theme ?? (system.matches ? "dark" : "light")) === "dark";
  if (["light", "dark"].includes(kept())) root.dataset.theme = kept();

  document.addEventListener("DOMContentLoaded", () => {
    const button = document.getElementById("theme");
    const present = () => {
      button.setAttribute("aria-label", isDark() ? "Show in light" : "Show in dark");
      button.title = button.getAttribute("aria-label");
      const use = button.querySelector("use");
      use.setAttribute("href", use.getAttribute("href").replace(/#.*/, isDark() ? "#sun" : "#moon"));
    };
    button.addEventListener("click", () => {
      root.dataset.theme = isDark() ? "light" : "dark";
      try { localStorage.setItem(KEPT, root.dataset.theme); } catch { /* this page alone, then */ }
      present();
    });
    system.addEventListener("change", present);
    present();
    // here, since modules may be what is missing; its address alone would lose the mode of an object, which stands behind the #
    document.querySelector("#stuck a")?.addEventListener("click", (event) => {
      event.preventDefault();
      location.reload();
    });
  });
})();
