
for (const viewer of document.querySelectorAll(".viewer")) {
  const { views, sides } = JSON.parse(viewer.querySelector("script").textContent);
  const [view, left, right] = viewer.querySelectorAll("select");
  const [under, over] = viewer.querySelectorAll(".pair img");
  const [slider, rule, ends] = [".pair input", ".pair b", ".ends"].map((s) => viewer.querySelector(s));
  const fill = (select, names) => names.forEach((name, i) => select.add(new Option(name, i)));
  fill(view, views);
  fill(left, sides.map((s) => s.name));
  fill(right, sides.map((s) => s.name));
  right.value = sides.length - 1;
  const show = () => {
    under.src = "data:image/png;base64," + sides[left.value].images[view.value];
    over.src = "data:image/png;base64," + sides[right.value].images[view.value];
    ends.children[0].textContent = sides[left.value].name;
    ends.children[1].textContent = sides[right.value].name;
    over.style.clipPath = `inset(0 0 0 ${slider.value}%)`;
    rule.style.left = slider.value + "%";
  };
  [view, left, right, slider].forEach((control) => control.addEventListener("input", show));
  show();
}
