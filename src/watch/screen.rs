//! Draws the model. 80 by 24 cells suffice; the screen states how many roles it omits.

use super::model::{Model, RoleLine, Series};
use super::tune::TuneView;
use crate::late::{LastLate, LateKind, LateStatus};
use crate::runtime::{PaceState, PaceStatus};
use crate::sample::RoleState;
use ratatui::backend::TestBackend;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Borders, Paragraph, Sparkline, SparklineBar};
use ratatui::{Frame, Terminal};

/// The smallest screen that is drawn.
const MIN_WIDTH: u16 = 60;
const MIN_HEIGHT: u16 = 12;
/// The height of the standard layout; taller screens show more roles and events.
const USUAL_HEIGHT: u16 = 24;
/// The lines for roles on a screen of the usual height, and the smallest numbers of lines for events and fields.
const ROLES: u16 = 8;
const EVENTS_MIN: u16 = 3;
const FIELDS_MIN: u16 = 5;
/// The columns for names and values beside a sparkline, for its scale, and for the name of a field.
const NAME_WIDTH: u16 = 24;
const SCALE_WIDTH: u16 = 6;
const FIELD_WIDTH: usize = 26;
/// The columns for the name of an input.
const INPUT_WIDTH: usize = 36;
/// The resolution of a sparkline, finer than any screen.
const STEPS: f64 = 1000.0;

const DIM: Style = Style::new().add_modifier(Modifier::DIM);
const BOLD: Style = Style::new().add_modifier(Modifier::BOLD);
const ALARM: Style = Style::new().fg(Color::Red).add_modifier(Modifier::BOLD);

/// Draws the model on a frame.
pub fn draw(model: &Model, frame: &mut Frame<'_>) {
    let area = frame.area();
    if area.width < MIN_WIDTH || area.height < MIN_HEIGHT {
        let text = format!("Enlarge the terminal to {MIN_WIDTH} x {MIN_HEIGHT}, better 80 x 24. q: quit");
        frame.render_widget(Paragraph::new(text), area);
        return;
    }
    let roles = (model.roles.len() as u16).min(ROLES + area.height.saturating_sub(USUAL_HEIGHT) / 2);
    let late = pace_line(model).into_iter().chain(late_line(model, usize::from(area.width))).collect::<Vec<_>>();
    // Each has the place of one event.
    let late_height = late.len() as u16;
    let events_min = EVENTS_MIN.saturating_sub(late_height).max(1);
    let roles_height = 1 + roles + late_height;
    // A sparkline has two lines if they fit.
    let fixed = 1 + roles_height + 1 + (1 + events_min) + (1 + FIELDS_MIN) + 1;
    let series = model.series.len() as u16;
    let lines = if area.height >= fixed + 2 * series { 2 } else { 1 };
    // Events get the lines that the fields of the selected signal do not need.
    let fixed = 1 + roles_height + (1 + lines * series) + 1;
    let fields = model.signals.get(model.selected).map_or(0, |signal| signal.fields.len() as u16).max(FIELDS_MIN);
    let events = area.height.saturating_sub(fixed + 1 + fields).max(1 + events_min);
    let [head, role_area, series_area, event_area, signal_area, foot] = Layout::vertical([
        Constraint::Length(1),
        Constraint::Length(roles_height),
        Constraint::Length(1 + lines * series),
        Constraint::Length(events),
        Constraint::Min(2),
        Constraint::Length(1),
    ])
    .areas(area);
    frame.render_widget(header(model), head);
    let role_lines = role_lines(model, usize::from(roles)).into_iter().chain(late);
    frame.render_widget(Paragraph::new(role_lines.collect::<Vec<_>>()), role_area);
    let series_area = section("errors, log scale, largest value per column", series_area, frame);
    draw_series(model, lines, frame, series_area);
    draw_events(model, frame, event_area);
    let keys = match &model.tune {
        None => {
            let signal_area = section(&signal_title(model, usize::from(area.width)), signal_area, frame);
            draw_signals(model, frame, signal_area);
            "q quit  space pause  up/down/tab signal  left/right fields  t tune"
        }
        Some(tune) => {
            let signal_area = section("inputs", signal_area, frame);
            draw_inputs(tune, frame, signal_area);
            "q quit  up/down input  left/right change  number, Enter: set  u undo  t signals"
        }
    };
    frame.render_widget(Line::styled(keys, DIM), foot);
}

/// Returns the screen as text, without colours.
pub fn text(model: &Model, width: u16, height: u16) -> String {
    let Ok(mut terminal) = Terminal::new(TestBackend::new(width, height));
    let Ok(drawn) = terminal.draw(|frame| draw(model, frame));
    let rows = drawn.buffer.content().chunks(usize::from(width));
    rows.map(|row| row.iter().map(|cell| cell.symbol()).collect::<String>().trim_end().to_owned() + "\n").collect()
}

/// Draws the title of a section and returns the area below it.
fn section(title: &str, area: Rect, frame: &mut Frame<'_>) -> Rect {
    let block = Block::new().borders(Borders::TOP).border_style(DIM).title(format!(" {title} "));
    let inner = block.inner(area);
    frame.render_widget(block, area);
    inner
}

fn header(model: &Model) -> Line<'static> {
    let Model { scenario, clock, tick, last_tick, tick_s, .. } = model;
    let text = match *clock {
        "realtime" => format!(
            "{clock} {:.0} Hz  {:.2} of {:.2} s",
            1.0 / tick_s,
            *tick as f64 * tick_s,
            *last_tick as f64 * tick_s
        ),
        _ => (*clock).to_owned(),
    };
    let state = match (model.ended, model.paused) {
        (true, _) => "  ended",
        (_, true) => "  paused",
        _ => "",
    };
    Line::from(vec![
        Span::styled(format!("corotate {scenario}"), BOLD),
        Span::raw(format!("  {text}  tick {tick}/{last_tick}")),
        Span::styled(state, ALARM),
    ])
}

fn role_lines(model: &Model, room: usize) -> Vec<Line<'static>> {
    let titles = format!(
        "{:<14} {:<7} {:>4} {:>9} {:>7} {:>6} {:>13} {:>13}",
        "role", "state", "life", "tick", "Hz", "missed", "due-sent us", "in-sent us"
    );
    let hidden = model.roles.len().saturating_sub(room);
    let shown = model.roles.len() - if hidden > 0 { hidden + 1 } else { 0 };
    let more = (hidden > 0).then(|| Line::styled(format!("... and {} more", hidden + 1), DIM));
    std::iter::once(Line::styled(titles, DIM)).chain(model.roles[..shown].iter().map(role_line)).chain(more).collect()
}

fn role_line(role: &RoleLine) -> Line<'static> {
    let state = RoleState::NAMES.into_iter().find(|(_, state)| *state == role.state).map_or("?", |(name, _)| name);
    let rate = role.rate.per_s().map_or("-".to_owned(), |rate| format!("{rate:.0}"));
    let percentiles = |window: &super::Window| {
        let pair = |[p50, p99]: [f64; 2]| format!("{}/{}", short(p50), short(p99));
        match window.ahead_us() {
            Some(us) => format!("ahead {}", short(us)),
            None => window.percentiles_us().map_or("-".to_owned(), pair),
        }
    };
    let alarmed = |alarm: bool| if alarm { ALARM } else { Style::new() };
    Line::from(vec![
        Span::raw(format!("{:<14} ", cut(&role.name, 14))),
        Span::styled(format!("{state:<7} "), alarmed(role.state == RoleState::Absent)),
        Span::styled(format!("{:>4} ", role.generation), alarmed(role.generation > 1)),
        Span::raw(format!("{:>9} {rate:>7} ", role.tick)),
        Span::styled(format!("{:>6} ", role.missed), alarmed(role.missed > 0)),
        Span::raw(format!("{:>13} {:>13}", percentiles(&role.lateness), percentiles(&role.step))),
    ])
}

/// Returns the number of late ticks, and the last one with its cause; `None` before the first.
fn late_line(model: &Model, width: usize) -> Option<Line<'static>> {
    let LateStatus { count, last, only_counted } = model.late.as_ref()?;
    let LastLate { role, tick, kind, late_us, cause } = last.as_ref()?;
    let which = if *only_counted { "last kept" } else { "last" };
    let kind = match kind {
        LateKind::Late => "",
        LateKind::Missed => "missed ",
        LateKind::Starved => "starved ",
    };
    let cause = cause.as_deref().unwrap_or("unknown cause");
    let text = format!("{count} late ticks, {which}: {role} {kind}{tick}, {} us: {cause}", short(*late_us));
    Some(Line::raw(cut(&text, width)))
}

/// Returns the relation of the grid to the device that sets the pace, if one does.
fn pace_line(model: &Model) -> Option<Line<'static>> {
    let PaceStatus { state, phase_error_ns, drift_ppm, slips } = model.pace?;
    let name: &str = state.into();
    let style = if state == PaceState::Locked { Style::new() } else { ALARM };
    Some(Line::from(vec![
        Span::raw("pace: "),
        Span::styled(name.to_owned(), style),
        Span::raw(format!(
            ", phase error {:+.1} us, drift {drift_ppm:+.1} ppm, {slips} slips",
            phase_error_ns as f64 / 1e3
        )),
    ]))
}

/// Formats a number of µs in few columns.
fn short(us: f64) -> String {
    match us {
        us if us < 10.0 => format!("{us:.1}"),
        us if us < 1e5 => format!("{us:.0}"),
        us => format!("{us:.0e}"),
    }
}

/// Cuts a text to a width, with `..` at the cut.
fn cut(text: &str, width: usize) -> String {
    match text.chars().count() {
        length if length <= width => text.to_owned(),
        _ => text.chars().take(width.saturating_sub(2)).collect::<String>() + "..",
    }
}

fn draw_series(model: &Model, lines: u16, frame: &mut Frame<'_>, area: Rect) {
    let rows = Layout::vertical(model.series.iter().map(|_| Constraint::Length(lines))).split(area);
    for (series, row) in model.series.iter().zip(rows.iter()) {
        let columns = [Constraint::Length(NAME_WIDTH), Constraint::Min(10), Constraint::Length(SCALE_WIDTH)];
        let [name, plot, scale] = Layout::horizontal(columns).areas(*row);
        let value = if series.last.is_nan() { "-".to_owned() } else { format!("{:.3e}", series.last) };
        let label = match lines {
            1 => vec![Line::raw(format!("{} {value}", cut(&series.name, 12)))],
            _ => vec![Line::raw(cut(&series.name, usize::from(NAME_WIDTH) - 1)), Line::styled(value, BOLD)],
        };
        frame.render_widget(Paragraph::new(label), name);
        draw_line(series, frame, plot, scale);
    }
}

/// Draws a sparkline and the decades that it spans.
fn draw_line(series: &Series, frame: &mut Frame<'_>, plot: Rect, scale: Rect) {
    let Some((low, high)) = series.history.decades() else { return };
    let level = |value: f64| {
        let part = (value.log10() - f64::from(low)) / f64::from(high - low);
        // Zero is drawn at the bottom, infinity at the top.
        SparklineBar::from((STEPS * part.clamp(0.0, 1.0)) as u64)
    };
    let bars: Vec<SparklineBar> = series.history.maxima(usize::from(plot.width)).into_iter().map(level).collect();
    frame.render_widget(Sparkline::default().max(STEPS as u64).data(bars), plot);
    let ends =
        if scale.height > 1 { vec![format!(" 1e{high}"), format!(" 1e{low}")] } else { vec![format!(" 1e{high}")] };
    frame.render_widget(Paragraph::new(ends.into_iter().map(|end| Line::styled(end, DIM)).collect::<Vec<_>>()), scale);
}

fn draw_events(model: &Model, frame: &mut Frame<'_>, area: Rect) {
    let title = match model.scripted {
        0 => format!("events ({})", model.events.len()),
        scripted => format!("events ({}); {scripted} injected faults in the scenario", model.events.len()),
    };
    let area = section(&title, area, frame);
    let newest = model.events.iter().rev().take(usize::from(area.height));
    let lines = newest.map(|event| Line::raw(format!("{:>9}  {}", event.tick, event.text)));
    frame.render_widget(Paragraph::new(lines.collect::<Vec<_>>()), area);
}

/// Returns the names of as many signals as fit, with the selected one marked.
fn signal_title(model: &Model, width: usize) -> String {
    let room = width.saturating_sub(" signals (999): ... ... ".len());
    let names: Vec<String> = model.signals.iter().map(|signal| cut(&signal.name, room)).collect();
    let length = |from: usize, to: usize| names[from..to].iter().map(|name| name.chars().count() + 2).sum::<usize>();
    let selected = model.selected.min(names.len().saturating_sub(1));
    let first = (0..=selected).find(|first| length(*first, names.len().min(selected + 1)) <= room).unwrap_or(selected);
    let end = (selected + 1..=names.len()).rev().find(|end| length(first, *end) <= room).unwrap_or(names.len());
    let marked = |(index, name): (usize, &String)| format!("{}{name} ", if index == selected { ">" } else { " " });
    let shown: String = names.iter().enumerate().take(end).skip(first).map(marked).collect();
    let more = |hidden: bool| if hidden { "..." } else { "" };
    let title = format!("signals ({}): {}{shown}{}", names.len(), more(first > 0), more(end < names.len()));
    title.trim_end().to_owned()
}

/// Draws the inputs around the selected one, and the outcome of the last change.
fn draw_inputs(tune: &TuneView, frame: &mut Frame<'_>, area: Rect) {
    let room = usize::from(area.height).saturating_sub(1);
    let first = (tune.selected + 1).saturating_sub(room);
    let row = |(index, (label, value)): (usize, &(String, String))| {
        let selected = index == tune.selected;
        let typed = if selected && !tune.typed.is_empty() { format!("  > {}_", tune.typed) } else { String::new() };
        let mark = if selected { '>' } else { ' ' };
        let style = if selected { BOLD } else { Style::new() };
        Line::styled(format!("{mark}{:<INPUT_WIDTH$} {value:>14}{typed}", cut(label, INPUT_WIDTH)), style)
    };
    let rows = tune.rows.iter().enumerate().skip(first).take(room).map(row);
    let message = Line::styled(cut(tune.message.lines().next().unwrap_or_default(), usize::from(area.width)), DIM);
    frame.render_widget(Paragraph::new(rows.chain([message]).collect::<Vec<_>>()), area);
}

/// Draws the fields of the selected signal, which the title names.
fn draw_signals(model: &Model, frame: &mut Frame<'_>, area: Rect) {
    let Some(selected) = model.signals.get(model.selected) else { return };
    let field =
        |(name, value): &(String, String)| Line::raw(format!(" {:<FIELD_WIDTH$} {value}", cut(name, FIELD_WIDTH)));
    let lines: Vec<Line<'_>> = match selected.fields.as_slice() {
        [] => vec![Line::styled(" no sample yet", DIM)],
        fields => fields.iter().skip(model.scroll).map(field).collect(),
    };
    frame.render_widget(Paragraph::new(lines), area);
}

#[cfg(test)]
mod tests {
    use super::super::{Event, SignalLine};
    use super::*;

    fn signal(name: &str, omega_rad_s: &str) -> SignalLine {
        let fields = [("tick", "1234"), ("omega_rad_s", omega_rad_s)];
        SignalLine { name: name.to_owned(), fields: fields.map(|(name, value)| (name.into(), value.into())).to_vec() }
    }

    fn model() -> Model {
        let mut leader = RoleLine::new("leader");
        (leader.state, leader.generation, leader.tick, leader.missed) = (RoleState::Running, 2, 1234, 7);
        (1..=100).for_each(|us| leader.lateness.push(0, us * 1000));
        let mut error = Series::new("sync_error_rad_s");
        (0..300).for_each(|k| error.push(10_f64.powf(-f64::from(k) / 30.0)));
        Model {
            scenario: "rigid-pair".to_owned(),
            clock: "realtime",
            tick: 1234,
            last_tick: 10_000,
            tick_s: 1e-3,
            roles: vec![leader, RoleLine::new("a-follower-with-a-long-name")],
            series: vec![error, Series::new("estimate_error_rad_s")],
            events: [Event { tick: 1200, text: "leader restarted: life 2".to_owned() }].into(),
            signals: vec![signal("leader/measurement", "+1.0000e0"), signal("leader/truth", "+2.0000e0")],
            ..Model::default()
        }
    }

    #[test]
    fn a_screen_of_80_by_24_shows_everything() {
        let text = text(&model(), 80, 24);
        for word in [
            "corotate rigid-pair  realtime 1000 Hz  1.23 of 10.00 s  tick 1234/10000",
            "leader         running    2      1234       -      7         50/99             -",
            "a-follower-w.. absent",
            "sync_error_rad_s",
            "1.080e-10",
            "1e0",
            "1e-10",
            "     1200  leader restarted: life 2",
            " signals (2): >leader/measurement  leader/truth ─",
            " tick                       1234",
            " omega_rad_s                +1.0000e0",
            "q quit",
        ] {
            assert!(text.contains(word), "{word}\n{text}");
        }
        assert_eq!(text.lines().count(), 24);
        assert!(text.lines().all(|line| line.chars().count() <= 80));
    }

    #[test]
    fn the_last_late_tick_has_a_line_with_its_cause() {
        let last = |kind, cause: Option<&str>| {
            let cause = cause.map(str::to_owned);
            Some(LastLate { role: "controller".to_owned(), tick: 4711, kind, late_us: 812.4, cause })
        };
        let hog = "task \"hog\" (thread 12, real-time priority 95)";
        let long = "x".repeat(200);
        for (status, line) in [
            (LateStatus::default(), None),
            (
                LateStatus { count: 3, last: last(LateKind::Late, Some(hog)), only_counted: false },
                Some(format!("3 late ticks, last: controller 4711, 812 us: {hog}")),
            ),
            (
                LateStatus { count: 9999, last: last(LateKind::Missed, None), only_counted: true },
                Some("9999 late ticks, last kept: controller missed 4711, 812 us: unknown cause".to_owned()),
            ),
            (
                LateStatus { count: 3, last: last(LateKind::Starved, Some(&long)), only_counted: false },
                Some("3 late ticks, last: controller starved 4711, 812 us: xxxxxxxxxxxxxxxxxxxxxxxxx..".to_owned()),
            ),
        ] {
            let model = Model { late: Some(status), ..model() };
            let text = text(&model, 80, 24);
            let shown = text.lines().find(|line| line.contains("late ticks")).map(|line| cut(line, 80));
            assert_eq!(shown, line.map(|line| cut(&line, 80)), "{text}");
            for word in ["1200  leader restarted", " omega_rad_s ", "q quit"] {
                assert!(text.contains(word), "{word}\n{text}");
            }
            // The errors still have two lines each.
            assert_eq!(text.lines().filter(|line| line.starts_with("1.080e-10")).count(), 1, "{text}");
        }
    }

    /// Only the fields of the marked signal are shown, and their lines contain no signal name.
    #[test]
    fn fields_belong_to_the_marked_signal() {
        let mut model = model();
        for (selected, value, hidden) in [(0, "+1.0000e0", "+2.0000e0"), (1, "+2.0000e0", "+1.0000e0")] {
            model.selected = selected;
            let text = text(&model, 80, 24);
            assert!(text.contains(&format!(">{}", model.signals[selected].name)), "{text}");
            assert_eq!(
                text.lines().find(|line| line.contains("omega")),
                Some(&*format!(" omega_rad_s                {value}"))
            );
            assert!(!text.contains(hidden), "{text}");
        }
    }

    /// A taller screen shows more events, and leaves no empty line between the sections while there are more.
    #[test]
    fn events_fill_the_available_height() {
        let mut model = model();
        model.events = (0..24).map(|tick| Event { tick, text: format!("event of {tick}") }).collect();
        for (height, shown) in [(24, 7), (30, 13), (40, 23), (41, 24), (50, 24)] {
            let text = text(&model, 120, height);
            assert_eq!(text.matches("event of").count(), shown, "{text}");
            assert!(text.contains("event of 23") && text.contains("+1.0000e0") && text.contains("q quit"), "{text}");
            assert!(shown == 24 || text.lines().filter(|line| line.is_empty()).count() == 3, "{text}");
        }
    }

    /// The bars of a decreasing error do not rise from left to right.
    #[test]
    fn the_sparkline_of_a_decreasing_error_decreases() {
        let text = text(&model(), 80, 24);
        let line = text.lines().find(|line| line.starts_with("sync_error_rad_s")).unwrap();
        let bars: Vec<u32> = line.chars().skip(24).take_while(|bar| *bar != ' ').map(u32::from).collect();
        assert!(bars.len() > 10 && bars.windows(2).all(|pair| pair[1] <= pair[0]), "{line}");
        assert!(bars[0] > bars[bars.len() - 1], "{line}");
    }

    #[test]
    fn every_screen_size_can_be_drawn() {
        let mut model = model();
        model.roles = (0..40).map(|index| RoleLine::new(&format!("follower-{index}"))).collect();
        model.signals =
            (0..90).map(|index| SignalLine { name: format!("f{index}/truth"), fields: Vec::new() }).collect();
        model.selected = 77;
        for (width, height) in [(1, 1), (60, 12), (80, 24), (59, 40), (200, 11), (300, 100)] {
            let text = text(&model, width, height);
            assert_eq!(text.lines().count(), usize::from(height));
            assert!(
                width < 80
                    || height < 24
                    || text.contains(">f77/truth") && text.contains("... and 33 more") == (height == 24),
                "{text}"
            );
        }
        model.paused = true;
        assert!(text(&model, 80, 24).contains("paused"));
        model.ended = true;
        assert!(text(&model, 80, 24).contains("ended"));
    }
}
