/* The page as a whole: recordings, tabs. */
"use strict";
(() => {
  const TABS = { overview: "Campaign", images: "Images", signals: "Channels", spectra: "Spectra", phasors: "Phasors" };

  function choose(name) {
    for (const tab of view.get("tabs").children) {
      const chosen = tab.dataset.tab === name;
      tab.setAttribute("aria-selected", String(chosen));
      tab.tabIndex = chosen ? 0 : -1;
      view.get(tab.dataset.tab).hidden = !chosen;
    }
    view.tab = name;
    view.parts[name]?.shown?.();
  }

  function tabs(recordings) {
    const told = view.told;
    const there = { overview: recordings > 1, images: told.pairs.length, signals: told.channels.length, spectra: told.channels.length,
      phasors: true };
    const names = Object.keys(TABS).filter((name) => there[name]);
    view.get("tabs").replaceChildren(...names.map((name) => {
      const tab = view.element("button", TABS[name], { type: "button", role: "tab", onclick: () => choose(name) });
      tab.dataset.tab = name;
      tab.setAttribute("aria-controls", name);
      return tab;
    }));
    for (const name of Object.keys(TABS)) view.get(name).hidden = true;
    return names;
  }

  /* List the problems of the recording, each once. */
  function problems(all) {
    const errors = [...new Map(all.map((one) => [`${one.code} ${one.where} ${one.text}`, one])).values()];
    const readable = view.told.pairs.length + view.told.channels.length;
    view.get("problems").hidden = !errors.length;
    view.get("problems").open = errors.length > 0 && (errors.length < 3 || !readable);
    view.get("problems-told").textContent = `${errors.length} problem${errors.length > 1 ? "s" : ""} in this recording: ${readable ? "its readable parts are shown" : "nothing of it can be read"}`;
    view.notices("problems-listed", errors);
  }

  /* What a run would refuse is looked for once the page is shown. */
  async function examine() {
    const { recording, told } = view;
    const { errors } = await view.ask("refusals");
    if (view.told === told) problems([...told.errors, ...errors]);
    document.body.dataset.examined = String(recording);
  }

  async function open(number, recordings) {
    view.recording = number;
    view.get("recordings").value = number;
    view.told = await view.ask("recording");
    view.get("name").textContent = view.told.name;
    document.title = `${view.told.name}: shakercal view`;
    problems(view.told.errors);
    const names = tabs(recordings);
    for (const part of Object.values(view.parts)) part.opened?.();
    choose(names.includes(view.tab) && view.tab !== "overview" ? view.tab : names[names[0] === "overview" && view.tab ? 1 : 0]);
    document.body.dataset.opened = String(number);
    setTimeout(() => examine().catch(view.fail), 0);
  }

  view.reopen = () => open(view.recording, view.get("recordings").options.length);

  async function start() {
    const { recordings } = await view.ask("sources");
    view.options("recordings", recordings.map((one) => one.name));
    view.get("recordings").onchange = (event) => open(Number(event.target.value), recordings.length).catch(view.fail);
    view.get("campaign").replaceChildren(...recordings.map((one, number) => {
      const button = view.element("button", one.name, { type: "button", onclick: () => {
        view.tab = "images";
        open(number, recordings.length).catch(view.fail);
      } });
      return view.row([button, one.excitation, one.images, one.channels, one.results]);
    }));
    await open(0, recordings.length);
  }

  view.get("tabs").addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!step) return;
    const all = [...view.get("tabs").children], at = all.findIndex((tab) => tab.dataset.tab === view.tab);
    const next = all[(at + step + all.length) % all.length];
    choose(next.dataset.tab);
    next.focus();
    event.preventDefault();
  });
  start().catch(view.fail);
})();
