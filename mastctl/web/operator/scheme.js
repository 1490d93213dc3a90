// Light or dark as this browser was told last, else as its system is; before the first paint, so no module.
{
  const KEPT = "mastctl-scheme";
  const root = document.documentElement;
  let chosen = null;
  try { chosen = localStorage.getItem(KEPT); } catch { /* nothing is kept here */ }
  if (["light", "dark"].includes(chosen)) root.dataset.scheme = chosen;
  const system = matchMedia("(prefers-color-scheme: light)");
  const now = () => root.dataset.scheme ?? (system.matches ? "light" : "dark");
  const other = () => (now() === "light" ? "dark" : "light");
  addEventListener("DOMContentLoaded", () => {
    const button = document.getElementById("scheme");
    const tell = () => { button.textContent = other() === "light" ? "Light" : "Dark"; button.setAttribute("aria-label", `Show the page ${other()}`); };
    button.addEventListener("click", () => {
      root.dataset.scheme = other();
      try { localStorage.setItem(KEPT, root.dataset.scheme); } catch { /* it holds until the page is left */ }
      tell();
    });
    system.addEventListener("change", tell);
    tell();
  });
}
