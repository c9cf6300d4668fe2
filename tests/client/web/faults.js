// What looks wrong on the page as it is now, in words: for tests in which nobody looks.
() => {
  const SLACK_PX = 1;
  const stage = document.getElementById("stage");
  const scope = stage.classList.contains("full") ? stage : document.body; // a full stage lies over the rest
  const isShown = (element) => element.getClientRects().length > 0 && element.checkVisibility({ visibilityProperty: true });
  const nameOf = (element) => element.id || element.name || element.className || element.textContent.trim().slice(0, 30);
  const shown = [...scope.querySelectorAll("*")].filter((element) => isShown(element) && element.closest(".hidden, svg, label.button > input") === null);
  const faults = [];

  const { scrollWidth, clientWidth } = document.scrollingElement;
  if (scrollWidth > clientWidth) faults.push(`the page is ${scrollWidth} wide in ${clientWidth}`);
  for (const element of shown) {
    const { left, right } = element.getBoundingClientRect();
    if (left < -SLACK_PX || right > innerWidth + SLACK_PX) faults.push(`${nameOf(element)} reaches from ${left} to ${right}`);
    const { overflowX } = getComputedStyle(element);
    if (overflowX !== "visible" && element.scrollWidth > element.clientWidth + SLACK_PX) faults.push(`${nameOf(element)} shows ${element.clientWidth} of ${element.scrollWidth}`);
  }

  const context = document.createElement("canvas").getContext("2d");
  for (const select of shown.filter((element) => element instanceof HTMLSelectElement && element.selectedIndex >= 0)) {
    const { font, paddingLeft, paddingRight } = getComputedStyle(select);
    context.font = font;
    const needed = context.measureText(select.selectedOptions[0].text).width + parseFloat(paddingLeft) + parseFloat(paddingRight);
    if (needed > select.clientWidth + SLACK_PX) faults.push(`${nameOf(select)} cuts its text: ${needed} in ${select.clientWidth}`);
  }

  const controls = shown.filter((element) => element.matches("button, select, input, summary, label.button"));
  controls.forEach((one, index) => {
    const a = one.getBoundingClientRect();
    for (const other of controls.slice(index + 1)) {
      const b = other.getBoundingClientRect();
      const isApart = a.right <= b.left + SLACK_PX || b.right <= a.left + SLACK_PX || a.bottom <= b.top + SLACK_PX || b.bottom <= a.top + SLACK_PX;
      if (!isApart) faults.push(`${nameOf(one)} and ${nameOf(other)} lie one upon another`);
    }
  });

  const frame = document.getElementById("picture-frame").getBoundingClientRect();
  if (frame.top + scrollY < 0 || frame.bottom + scrollY > innerHeight + SLACK_PX || frame.height < innerHeight / 4) faults.push(`the picture reaches from ${frame.top + scrollY} to ${frame.bottom + scrollY}`);
  return faults;
}
